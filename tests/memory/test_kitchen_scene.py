"""A scene of a real place: most of its Kinect frames are fused into cells, and the others agree with these."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from persist_cli.api.cells import CellGrid
from persist_cli.api.geometry import unproject
from persist_cli.cli.app import main
from persist_cli.data.importers.importing import ImportPlan, run_import
from persist_cli.data.store import Store
from persist_cli.memorize.memory_file import load_memory
from tests.support.room_views import KITCHEN

HELD_OUT = (5, 11, 17)  # of 24 frames


@dataclass(frozen=True)
class Kitchen:
    """The cells of a scene, and what frames saw that are not in it.

    Args:
        grid: the cells.
        centers: of the camera that saw each point.
        points: on surfaces, world metres.
        rgb: of their pixels.
    """

    grid: CellGrid
    centers: Float[Tensor, "point 3"]
    points: Float[Tensor, "point 3"]
    rgb: Float[Tensor, "point 3"]

    def cells(self, points: Float[Tensor, "point 3"]) -> tuple[tuple[Tensor, ...], Bool[Tensor, " point"]]:
        """Places in the grid of the points that lie in known cells, and which they are."""
        places = (points @ self.grid.axes.T / self.grid.form.size).round().long() - torch.tensor(self.grid.corner)
        within = ((places >= 0) & (places < torch.tensor(self.grid.shape))).all(-1)
        known = within.clone()
        known[within] = self.grid.known[tuple(places[within].T)]
        return tuple(places[known].T), known


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory) -> Kitchen:
    if not KITCHEN.is_dir():
        pytest.skip("the Kinect frames of ../shared/data/kitchen are not here")
    folder = tmp_path_factory.mktemp("kitchen")
    run_import("7scenes", KITCHEN, folder / "data", ImportPlan(size=(96, 128), every=5), False)
    ends = zip((0, *(number + 1 for number in HELD_OUT)), (*HELD_OUT, 24), strict=True)
    frames = [f"{folder}/data#0:{first}-{end}" for first, end in ends]
    with pytest.raises(SystemExit) as ended:
        main(["memorize", *frames, "--memory", "scene", "--set", "memory.size=0.1", "--out", f"{folder}/scene"])
    assert ended.value.code == 0
    seen = Store(folder / "data")[0].read(list(HELD_OUT)).observations
    believed = seen.depth > 0
    centers = seen.cameras.centers[:, None, None].double().expand(*believed.shape, 3)
    points = unproject(seen.depth, seen.cameras)
    return Kitchen(
        load_memory(folder / "scene").cells, centers[believed], points[believed], seen.rgb[believed].double()
    )


def test_surfaces_that_other_frames_see_lie_in_solid_cells(kitchen):
    at, known = kitchen.cells(kitchen.points)
    assert len(known) > 20_000
    assert known.double().mean() > 0.9
    assert kitchen.grid.solid[at].double().mean() > 0.93


@pytest.mark.parametrize(("share", "most"), [(0.5, 0.03), (0.8, 0.06)])
def test_the_way_to_what_other_frames_see_is_free(kitchen, share, most):
    at, known = kitchen.cells(kitchen.centers + share * (kitchen.points - kitchen.centers))
    assert known.double().mean() > 0.85
    assert kitchen.grid.solid[at].double().mean() < most


def test_cells_have_the_colours_that_other_frames_see(kitchen):
    at, known = kitchen.cells(kitchen.points)
    solid = kitchen.grid.solid[at]
    seen, held = kitchen.rgb[known][solid], kitchen.grid.colors[at][solid].double()
    shuffled = held[torch.randperm(len(held), generator=torch.Generator().manual_seed(0))]
    error, chance = ((seen - colors).abs().mean(1).median() for colors in (held, shuffled))
    assert error < 0.5 * chance
