"""Samples for models of scenes: what is known of the cells around a camera, and what is really there.

Sample n depends on the seed and on n only. What is known is what a scene knows after real frames, written as in use.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from torch import Tensor
from torch.utils.data import Dataset

from persist_cli.api.cell_things import STRUCTURE
from persist_cli.api.cells import COMMON, FREE, SOLID, CellGrid
from persist_cli.api.reach import cells_in_reach
from persist_cli.api.scene_model import Given, SceneForm, SceneSamples, no_view, window_pose
from persist_cli.api.scene_turns import Turn
from persist_cli.data.scene_truth import DROP, NOTHING, PICK_UP, Carried, Interaction, SceneTruths, settled
from persist_cli.data.store import Store, TrajectoryFile
from persist_cli.data.written_scenes import SceneWriter, TensorStore, WrittenScene
from persist_cli.errors import DataError

MOST_FRAMES: Final = 24  # that a scene is written from
STRIDES: Final = 4  # from frame to frame of these, at most
FIXED: Final = 8  # single frames and as many walks that each trajectory offers, so that they come again and are kept
JITTER: Final = 8  # cells that a window may lie beside the camera; of kind grown it lies anywhere around it
TRIES: Final = 16  # of finding a trajectory with interactions


@dataclass(frozen=True)
class SampleShares:
    """How often samples are of each kind, and what they are told.

    Args:
        frame: one frame is known.
        walk: up to 24 frames of a walk are known.
        grown: beside the newest frame, a large part of the truth is known, as if it had been imagined before.
        interaction: what becomes of the known cells before the agent by an interaction.
        named: share of the frames and walks that know the classes of observed cells, as after they were completed.
        named_acting: the same share of the interactions.
        unseen: share of the samples of kind grown that have no view.
        idle: share of the interactions that find nothing to act on, and change nothing.
    """

    frame: float = 0.45
    walk: float = 0.2
    grown: float = 0.2
    interaction: float = 0.15
    named: float = 0.1
    named_acting: float = 0.5
    unseen: float = 0.3
    idle: float = 0.15


@dataclass(frozen=True)
class Window:
    """One sample before it is turned and mirrored.

    Args:
        given: the ``Given`` of each cell.
        seen: what is given.
        truth: what the cells hold, as far as it is known.
        scene: gives the view.
        action: name of the interaction, empty for none.
        carried: what the agent carries before it.
        blind: whether the view is left out.
    """

    given: UInt8[Tensor, "first second level"]
    seen: CellGrid
    truth: CellGrid
    scene: WrittenScene
    action: str = ""
    carried: Carried = NOTHING
    blind: bool = False


class SceneSampleDataset(Dataset[SceneSamples]):
    """Endless samples of some data sets; sample n depends on the seed and on n only.

    Args:
        folders: folders of the data sets. Trajectories without cells are left out where the form's cells have names;
            else their cells are fused from their frames.
        form: the windows.
        seed: seed of the draws.
        shares: how often samples are of each kind.
        cache: keeps what scenes know, which takes most of the time; without it some thousand stay in memory.

    Raises:
        DataError: when no trajectory has cells that it needs, or they or the images are not those of the form.
    """

    def __init__(
        self,
        folders: Sequence[Path],
        form: SceneForm,
        seed: int,
        shares: SampleShares | None = None,
        cache: TensorStore | None = None,
    ) -> None:
        self.form, self.seed, self.shares = form, seed, shares or SampleShares()
        self.files = [file for folder in folders for file in Store(folder) if file.has_cells or form.cells.of_depth]
        if not self.files:
            where = " and ".join(map(str, folders))
            raise DataError(
                f"{where}: no trajectory has the cells of its scene; `persist collect miniworld` writes them. "
                "fused-64-scene-codec learns from captures with depth"
            )
        for file in self.files:
            _check_form(file, form)
        self.writer = SceneWriter(form.cells, cache)
        self.truths = SceneTruths(self.writer)

    def __getitem__(self, number: int) -> SceneSamples:
        random = np.random.default_rng((self.seed, number))
        kinds = {"frame": self._frame, "walk": self._walk, "grown": self._grown, "interaction": self._interaction}
        weights = np.array([getattr(self.shares, kind) for kind in kinds])
        kind = str(random.choice(list(kinds), p=weights / weights.sum()))
        return self._sample(kinds[kind](random), random)

    def _frame(self, random: np.random.Generator) -> Window:
        """A sample of which one frame is known."""
        file = self._file(random)
        return self._observed(file, self._frames(file, 2 * int(random.integers(FIXED))), random, self.shares.named)

    def _walk(self, random: np.random.Generator) -> Window:
        """A sample of which some frames of a walk up to now are known."""
        return self._walk_of(self._file(random), random, self.shares.named)

    def _grown(self, random: np.random.Generator) -> Window:
        """A sample of which much is known by class, and the rest is to go on from it."""
        file = self._file(random)
        window = self._observed(file, self._frames(file, int(random.integers(2 * FIXED))), random, 1.0, grown=True)
        known = random_part(self.form.shape, random)
        seen, given = window.seen.copy(), window.given.clone()
        fresh = known & (given == Given.NOTHING) & window.truth.known
        for mine, true in zip(seen.tensors()[:2], window.truth.tensors()[:2], strict=True):
            mine[fresh] = true[fresh]
        given[fresh] = int(Given.CONTENT)
        return replace(window, seen=seen, given=given, blind=bool(random.random() < self.shares.unseen))

    def _interaction(self, random: np.random.Generator) -> Window:
        """A sample of an interaction; of a walk where the data sets have too few of them."""
        for _ in range(TRIES):
            file = self._file(random)
            events = [event for event in self.truths.interactions(file) if event.action in self.form.actions]
            if events:
                if random.random() < self.shares.idle:
                    return self._idle(file, random)
                return self._event(file, events[int(random.integers(len(events)))], random)
        return self._walk(random)

    def _event(self, file: TrajectoryFile, event: Interaction, random: np.random.Generator) -> Window:
        """What an interaction changes; a thing that is picked up is then carried, and in no cell."""
        before = self._observed(file, self._event_frames(file, event), random, self.shares.named_acting)
        after, was = (self.truths.around(file, event.frame + later, before.seen) for later in (1, 0))
        if event.action == PICK_UP:
            appeared = after.solid & ~was.solid
            after.classes[appeared], after.colors[appeared] = FREE, 0
        changed = (after.classes != was.classes) | (after.colors != was.colors).any(dim=-1)
        return self._acted(before, event.action, (after, changed))

    def _idle(self, file: TrajectoryFile, random: np.random.Generator) -> Window:
        """An interaction that finds nothing to act on; a mere walk where something is in reach."""
        window = self._walk_of(file, random, self.shares.named_acting)
        action = self.form.actions[int(random.integers(len(self.form.actions)))]
        pose = window.scene.view.cameras.world_from_camera[0]
        things = is_thing(window.truth) & cells_in_reach(window.truth, pose)
        if window.carried.kind or (bool(things.any()) and action != DROP):
            return window
        return self._acted(window, action, (window.truth, torch.zeros_like(things)))

    def _walk_of(self, file: TrajectoryFile, random: np.random.Generator, named: float) -> Window:
        return self._observed(file, self._frames(file, 2 * int(random.integers(FIXED)) + 1), random, named)

    def _acted(
        self, before: Window, action: str, outcome: tuple[CellGrid, Bool[Tensor, "first second level"]]
    ) -> Window:
        """A window in which the known cells in reach are past, and changed ones hold something else."""
        after, changed = outcome
        past = (before.given == Given.CONTENT) & cells_in_reach(
            before.seen, before.scene.view.cameras.world_from_camera[0]
        )
        given = torch.where(past, int(Given.PAST), before.given.int()).to(torch.uint8)
        changed = changed & (given != Given.CONTENT)
        truth = before.truth.copy()
        for mine, true in zip(truth.tensors()[:2], after.tensors()[:2], strict=True):
            mine[changed] = true[changed]
        return replace(before, given=given, truth=truth, action=action)

    def _observed(
        self, file: TrajectoryFile, frames: list[int], random: np.random.Generator, named: float, grown: bool = False
    ) -> Window:
        """A window around the newest of some frames, of which a scene knows what these show, some of them by name.

        A grown one holds the camera anywhere: an agent walks on, and the view stays where it was.
        """
        scene = self.writer.scene(file, frames)
        floor = self.truths.floor(file, frames[-1])
        corner = self._corner(scene, floor, random, max(self.form.shape[:2]) if grown else JITTER)
        seen = scene.known.box(corner, self.form.shape)
        truth = settled(self.truths.around(file, frames[-1], seen), seen)
        if random.random() < named:
            unnamed = seen.known & (seen.classes == SOLID)
            seen.classes[unnamed] = truth.classes[unnamed]
        given = torch.where(seen.known, int(Given.CONTENT), int(Given.NOTHING)).to(torch.uint8)
        return Window(given, seen, truth, scene, carried=self.truths.carried(file, frames[-1]))

    def _corner(self, scene: WrittenScene, floor: int, random: np.random.Generator, most: int) -> tuple[int, int, int]:
        """The lowest cell of a window around the camera or at most so many cells beside it, from the floor up."""
        first, second, _ = scene.known.numbers(scene.view.cameras.centers[0]).tolist()
        most = most if random.random() < 0.5 else 0
        limits = [min(most, side // 2 - 1) for side in self.form.shape[:2]]
        by_first, by_second = (int(random.integers(-limit, limit + 1)) for limit in limits)
        rows, columns, _ = self.form.shape
        return first - rows // 2 + by_first, second - columns // 2 + by_second, floor

    def _sample(self, window: Window, random: np.random.Generator) -> SceneSamples:
        """The sample of a window, turned so that its camera looks along the first axis, and mirrored at random.

        One without a view is turned at random, too.
        """
        known = window.given > Given.NOTHING
        view, form = window.scene.view, self.form
        cells = {
            "given": window.given,
            "classes": window.seen.classes * known,
            "colors": window.seen.colors * known[..., None],
            "true_classes": window.truth.classes,
            "true_colors": window.truth.colors,
            "true_known": window.truth.known,
        }
        pose, lens = window_pose(window.seen, view.cameras.world_from_camera[0]), view.cameras.intrinsics[0].double()
        turned = Turn.draw(form.shape, random)
        if not window.blind:
            turned = Turn.ahead(pose, form.shape, turned.mirrored)
        cells = {name: turned.cells(part) for name, part in cells.items()}
        rgb, depth = (turned.image(image) for image in (view.rgb[0], view.depth[0]))
        pose, lens = turned.pose(pose, form), turned.lens(lens, form.image[1])
        if window.blind:
            rgb, depth, pose, lens = no_view(form)
        return SceneSamples(
            **cells,
            rgb=rgb,
            depth=depth.float(),
            window_from_camera=pose.float(),
            intrinsics=lens.float(),
            action=torch.tensor(1 + form.actions.index(window.action) if window.action else 0),
            carried=torch.tensor(window.carried.kind),
            carried_color=torch.tensor(window.carried.color, dtype=torch.uint8),
            seeds=torch.tensor(int(random.integers(2**62))),
        )

    def _file(self, random: np.random.Generator) -> TrajectoryFile:
        return self.files[int(random.integers(len(self.files)))]

    def _frames(self, file: TrajectoryFile, state: int) -> list[int]:
        """The frames of one of the trajectory's fixed states; even ones are single frames, odd ones walks."""
        random = np.random.default_rng([self.seed, len(file), state, *file.name.encode()])
        return _frames_up_to(int(random.integers(len(file))), state % 2 == 1, random)

    def _event_frames(self, file: TrajectoryFile, event: Interaction) -> list[int]:
        """The frames of a walk up to an interaction, the same each time."""
        return _frames_up_to(event.frame, True, np.random.default_rng([self.seed, event.frame, *file.name.encode()]))

    def check_interactions(self) -> None:
        """Raise ``DataError`` when no trajectory has an interaction that the form knows."""
        known = self.form.actions
        if not any(event.action in known for file in self.files for event in self.truths.interactions(file)):
            where = " and ".join(dict.fromkeys(str(file.path.parent) for file in self.files))
            raise DataError(
                f"{where}: no trajectory has an action {', '.join(known)}; `persist collect miniworld "
                "--policy interact` writes such"
            )


def is_thing(grid: CellGrid) -> Bool[Tensor, "first second level"]:
    """Which cells hold a thing: something that is no floor, wall, ceiling or piece above a door."""
    rest = [number for number, name in enumerate(grid.form.palette) if name not in (*COMMON, *STRUCTURE)]
    return torch.isin(grid.classes, torch.tensor(rest, dtype=torch.uint8))


def random_part(shape: tuple[int, int, int], random: np.random.Generator) -> Bool[Tensor, "first second level"]:
    """A random part of a window that is known: a half, a corner less, a middle, or all but some boxes."""
    known = torch.ones(shape, dtype=torch.bool)
    kind = random.choice(["half", "corner", "middle", "boxes"])
    if kind == "boxes":
        for _ in range(int(random.integers(1, 5))):
            known[_random_box(shape, random)] = False
        return known
    cuts = [int(random.integers(side // 5, side - side // 5)) for side in shape[:2]]
    if kind == "middle":
        sides = [(int(random.integers(0, side // 3)), int(random.integers(2 * side // 3, side))) for side in shape[:2]]
        inside = torch.zeros(shape, dtype=torch.bool)
        inside[sides[0][0] : sides[0][1], sides[1][0] : sides[1][1]] = True
        return inside
    first, second = torch.zeros(shape, dtype=torch.bool), torch.zeros(shape, dtype=torch.bool)
    first[: cuts[0]], second[:, : cuts[1]] = True, True
    first, second = (part ^ bool(random.integers(2)) for part in (first, second))
    if kind == "half":
        return first if random.random() < 0.5 else second
    return first | second


def _random_box(shape: tuple[int, int, int], random: np.random.Generator) -> tuple[slice, slice, slice]:
    """A box of the window, of two cells to half of it along the ground, and of any height."""
    slices = []
    for side in shape:
        length = int(random.integers(min(2, side), max(3, side // 2 + 1)))
        low = int(random.integers(0, max(1, side - length + 1)))
        slices.append(slice(low, low + length))
    first, second, level = slices
    return first, second, level if random.random() < 0.5 else slice(None)


def _frames_up_to(last: int, walk: bool, random: np.random.Generator) -> list[int]:
    """The frame alone, or 2 to 24 frames of the way to it."""
    if not walk:
        return [last]
    count = round(2 * (MOST_FRAMES / 2) ** float(random.random()))  # few frames as often as many
    stride = int(random.integers(1, STRIDES + 1))
    return [frame for frame in range(last - (count - 1) * stride, last + 1, stride) if frame >= 0]


def _check_form(file: TrajectoryFile, form: SceneForm) -> None:
    """Raise ``DataError`` where a trajectory's cells or images are not those of the form."""
    if (file.info.height, file.info.width) != form.image:
        size = f"{file.info.height}x{file.info.width}"
        raise DataError(f"{file.path}: images are {size}, the scene model takes {form.image[0]}x{form.image[1]}")
    cells = file.cell_form
    if cells != form.cells and cells is not None:
        raise DataError(
            f"{file.path}: its cells of {cells.size:g} m and the classes {', '.join(cells.palette)} are not those of "
            f"the scene model: {form.cells.size:g} m and {', '.join(form.cells.palette)}"
        )
