"""Samples of scenes: what is known agrees with the truth, lies where the view sees it, and changes by interactions."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from persist_cli.api.cameras import Cameras
from persist_cli.api.cell_things import STRUCTURE
from persist_cli.api.cells import COMMON, FREE, OUTSIDE, SOLID, CellForm, CellGrid
from persist_cli.api.geometry import unproject
from persist_cli.api.reach import CHANGED
from persist_cli.api.scene_model import Given, SceneForm, SceneSamples
from persist_cli.api.scene_turns import Turn
from persist_cli.data.file_hashes import FileHashes
from persist_cli.data.scene_samples import (
    FIXED,
    JITTER,
    MOST_FRAMES,
    SampleShares,
    SceneSampleDataset,
    _frames_up_to,
)
from persist_cli.data.store import TrajectoryFile, write_trajectory
from persist_cli.errors import DataError
from persist_cli.simulators.collect import CollectPlan, collect_frames
from persist_cli.simulators.house_cells import FORM
from tests.support.miniworlds import make_world
from tests.support.noise import INFO, make_frames

WINDOW = SceneForm(FORM, (40, 40, 12), (32, 32))
UNNAMED = replace(WINDOW, cells=CellForm(FORM.size))  # of captures, which know no classes
KINDS = [field.name for field in fields(SampleShares) if field.name not in ("named", "named_acting", "unseen", "idle")]


@pytest.fixture(scope="session")
def houses(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two houses in which an agent interacts."""
    return write_walks(tmp_path_factory.mktemp("houses"))


@pytest.fixture(scope="session")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same walks as captures, which know nothing of the cells of their houses."""
    return write_walks(tmp_path_factory.mktemp("captures"), cells=None)


def write_walks(folder: Path, **changes: Any) -> Path:
    world = make_world(height=32, width=32)
    plan = CollectPlan(simulator="miniworld", scenes="0:10", frames=48, size="32x32", policy="interact")
    for seed in (9001, 9002):
        frames = (replace(frame, **changes) for frame in collect_frames(world, plan, seed))
        write_trajectory(folder / f"house-{seed}.parquet", world.info, frames)
    return folder


def samples_of(houses: Path, kind: str, **shares: float) -> SceneSampleDataset:
    only = {name: float(name == kind) for name in KINDS}
    return SceneSampleDataset([houses], WINDOW, 5, SampleShares(**only, **shares))


def first_with(dataset: SceneSampleDataset, action: str) -> SceneSamples:
    wanted = 1 + WINDOW.actions.index(action)
    return next(sample for sample in map(dataset.__getitem__, range(100)) if sample.action == wanted)


def things(classes: torch.Tensor) -> torch.Tensor:
    return classes >= len(COMMON) + len(STRUCTURE)


def truths(sample: SceneSamples) -> tuple[torch.Tensor, torch.Tensor]:
    assert sample.true_classes is not None
    assert sample.true_colors is not None
    return sample.true_classes, sample.true_colors


@pytest.mark.parametrize("kind", KINDS)
def test_a_sample_depends_on_seed_and_number_alone(houses: Path, kind: str) -> None:
    first, again = samples_of(houses, kind), samples_of(houses, kind)
    _ = again[8], again[3]
    mine, theirs = first[3].tensors(), again[3].tensors()
    assert all(torch.equal(mine[name], theirs[name]) for name in mine)


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_given_for_good_is_what_is_there(houses: Path, kind: str) -> None:
    for number in range(6):
        sample = samples_of(houses, kind)[number]
        classes, colors = truths(sample)
        content = sample.given == Given.CONTENT
        named, solid = content & (sample.classes != SOLID), content & (sample.classes == SOLID)
        assert content.any()
        assert torch.equal(sample.classes[named], classes[named])
        assert not torch.isin(classes[solid], torch.tensor([FREE, OUTSIDE])).any()
        assert torch.equal(sample.colors[content], colors[content])


@pytest.mark.parametrize("turn", [Turn(quarters, mirrored) for quarters in range(4) for mirrored in (False, True)])
def test_what_the_view_sees_is_known_to_be_solid_in_every_turn(
    houses: Path, turn: Turn, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Turn, "ahead", staticmethod(lambda pose, shape, mirrored: turn))
    sample = samples_of(houses, "frame", named=0.0)[0]
    cameras = Cameras(sample.window_from_camera[None].double(), sample.intrinsics[None].double(), *WINDOW.image)
    points = unproject(sample.depth[None], cameras)[0]
    ways = points - cameras.centers[0]
    cells = ((points + 0.05 * ways / ways.norm(dim=-1, keepdim=True)) / FORM.size).round().long()
    inside = ((cells >= 0) & (cells < torch.tensor(WINDOW.shape))).all(dim=-1) & (sample.depth > 0)
    assert (sample.classes[cells[inside].unbind(-1)] == SOLID).float().mean() > 0.93


def test_cameras_look_along_the_first_axis_of_their_window(houses: Path) -> None:
    for kind in ("frame", "walk"):
        dataset = samples_of(houses, kind)
        for number in range(6):
            first, second = dataset[number].window_from_camera[:2, 2].tolist()
            assert first >= abs(second)


def test_a_turn_is_undone() -> None:
    cells = torch.rand(40, 40, 12)
    for turn in (Turn(quarters, mirrored) for quarters in range(4) for mirrored in (False, True)):
        assert torch.equal(turn.back(turn.cells(cells)), cells)


def test_a_turn_of_all_four_quarters_and_two_mirrors_change_nothing() -> None:
    cells, pose = torch.rand(40, 40, 12), torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([1.0, 2.0, 0.5])
    turned, moved = cells, pose
    for _ in range(4):
        turned, moved = Turn(1, False).cells(turned), Turn(1, False).pose(moved, WINDOW)
    for _ in range(2):
        turned, moved = Turn(0, True).cells(turned), Turn(0, True).pose(moved, WINDOW)
    assert torch.equal(turned, cells)
    assert torch.allclose(moved, pose)


@pytest.mark.parametrize(("kind", "share"), [("frame", "named"), ("walk", "named"), ("interaction", "named_acting")])
@pytest.mark.parametrize("idle", [0.0, 1.0])
@pytest.mark.parametrize("known", [0.0, 1.0])
def test_the_classes_of_what_was_seen_are_known_in_the_share_of_its_kind(
    houses: Path, kind: str, share: str, idle: float, known: float
) -> None:
    shares = {"named": 1 - known, "named_acting": 1 - known} | {share: known}
    dataset = samples_of(houses, kind, **shares, idle=idle)
    for sample in map(dataset.__getitem__, range(3)):
        solid = (sample.given > 0) & (sample.classes != FREE)
        assert (sample.classes[solid] != SOLID).float().mean().round() == known


def test_windows_lie_around_the_camera_and_those_of_grown_samples_anywhere_around_it(houses: Path) -> None:
    apart = {}
    for kind in ("frame", "grown"):
        dataset = samples_of(houses, kind, unseen=0.0)
        places = torch.stack([dataset[number].window_from_camera[:2, 3] for number in range(12)])
        apart[kind] = ((places / FORM.size) - torch.tensor(WINDOW.shape[:2]) / 2).abs().amax(dim=1)
    assert apart["frame"].max() <= JITTER + 1
    assert (apart["frame"] < 1.01).sum() >= 2  # half of them around it
    assert (apart["frame"] > 1.01).sum() >= 2
    assert apart["grown"].max() > JITTER + 1


def test_each_sample_has_noise_of_its_own(houses: Path) -> None:
    dataset = samples_of(houses, "frame")
    assert len({int(dataset[number].seeds) for number in range(4)}) == 4


def test_single_frames_and_walks_come_again_and_there_are_several_of_each(houses: Path) -> None:
    views = [samples_of(houses, "frame")[number].rgb for number in range(12)]
    distinct = {tuple(view.float().mean((0, 1)).tolist()) for view in views}
    assert 3 <= len(distinct) <= 2 * FIXED


def test_a_walk_knows_more_than_a_frame(houses: Path) -> None:
    known = [sum(int((samples_of(houses, kind)[n].given > 0).sum()) for n in range(6)) for kind in ("frame", "walk")]
    assert known[1] > 1.5 * known[0]


def test_what_lies_beyond_the_house_is_outside(houses: Path) -> None:
    classes, colors = truths(samples_of(houses, "frame")[0])
    outside = classes == OUTSIDE
    assert 0.1 < outside.float().mean() < 0.9
    assert not colors[outside].any()


def test_grown_samples_know_a_large_part_by_class_and_leave_another(houses: Path) -> None:
    for number in range(6):
        given = samples_of(houses, "grown")[number].given
        assert 0.1 < (given == Given.CONTENT).float().mean() < 1


def test_a_sample_without_a_view_says_nothing_about_one(houses: Path) -> None:
    sample = samples_of(houses, "grown", unseen=1.0)[0]
    assert not sample.rgb.any()
    assert not sample.depth.any()
    assert torch.equal(sample.window_from_camera, torch.eye(4))


def test_a_thing_that_is_picked_up_is_gone(houses: Path) -> None:
    sample = first_with(samples_of(houses, "interaction", idle=0.0), "pick_up")
    classes, _ = truths(sample)
    past = sample.given == Given.PAST
    vanished = past & (sample.classes != FREE) & (classes == FREE)
    assert vanished.any()
    assert not (past & (sample.classes == FREE) & things(classes)).any()
    assert sample.carried == 0


def fill_level_after(action: str, dataset: SceneSampleDataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a whole level be solid in the frames after an interaction."""
    known, around = dataset.truths, dataset.truths.around
    later = {event.frame + 1 for file in dataset.files for event in known.interactions(file) if event.action == action}

    def filled(file: TrajectoryFile, frame: int, window: CellGrid) -> CellGrid:
        part = around(file, frame, window)
        if frame in later:
            part.classes[..., 5][part.classes[..., 5] == FREE] = SOLID
        return part

    monkeypatch.setattr(known, "around", filled)


def test_what_appears_when_a_thing_is_picked_up_is_in_no_cell(houses: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = samples_of(houses, "interaction", idle=0.0)
    plain, _ = truths(first_with(dataset, "pick_up"))
    fill_level_after("pick_up", dataset, monkeypatch)
    assert torch.equal(truths(first_with(dataset, "pick_up"))[0], plain)


def test_what_an_interaction_changes_out_of_reach_is_not_told(houses: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = samples_of(houses, "interaction", idle=0.0, named_acting=1.0)
    fill_level_after("drop", dataset, monkeypatch)
    sample = first_with(dataset, "drop")
    classes, content = truths(sample)[0][..., 5], sample.given[..., 5] == Given.CONTENT
    assert bool((classes == SOLID).any())
    assert torch.equal(classes[content], sample.classes[..., 5][content])


def test_a_thing_that_is_dropped_is_there_again(houses: Path) -> None:
    sample = first_with(samples_of(houses, "interaction", idle=0.0), "drop")
    classes, _ = truths(sample)
    assert things(sample.carried)
    assert sample.carried_color.any()
    dropped = (sample.given != Given.CONTENT) & (classes == sample.carried)
    away = (truths(sample)[1][dropped].float() - sample.carried_color).abs().amax(dim=-1)
    assert away.min() < 30  # the mean of the thing's cells
    assert (classes[sample.given != Given.CONTENT] == sample.carried).any()


def test_an_interaction_changes_only_cells_in_reach(houses: Path) -> None:
    sample = first_with(samples_of(houses, "interaction", idle=0.0), "pick_up")
    places = (sample.given == Given.PAST).nonzero()[:, :2] * FORM.size
    assert (places - sample.window_from_camera[:2, 3]).norm(dim=-1).max() <= CHANGED + 1e-3


def test_an_interaction_with_nothing_changes_nothing(houses: Path) -> None:
    dataset = samples_of(houses, "interaction", idle=1.0)
    idle = [sample for sample in map(dataset.__getitem__, range(40)) if sample.action > 0]
    assert idle
    for sample in idle:
        classes, _ = truths(sample)
        free = (sample.given == Given.PAST) & (sample.classes == FREE)
        assert (classes[free] == FREE).all()


class Shelf(dict[str, Any]):
    """A cache in memory."""

    hashes = FileHashes()

    def put(self, key: str, tensors: Any) -> None:
        self[key] = tensors


def test_a_cache_keeps_what_scenes_know_and_changes_no_sample(houses: Path) -> None:
    shelf = Shelf()
    bare = SceneSampleDataset([houses], WINDOW, 0)[1].tensors()
    for _ in range(2):
        kept = SceneSampleDataset([houses], WINDOW, 0, cache=shelf)[1].tensors()
        assert all(torch.equal(bare[name], kept[name]) for name in bare)
    assert len(shelf) == 1


def test_data_without_cells_are_refused(tmp_path: Path) -> None:
    write_trajectory(tmp_path / "one.parquet", INFO, make_frames(4))
    with pytest.raises(DataError, match=r"no trajectory has the cells of its scene; .* fused-64-scene-codec learns"):
        SceneSampleDataset([tmp_path], WINDOW, 0)


@pytest.mark.parametrize("kind", KINDS)
def test_of_a_capture_only_what_its_frames_show_is_known(captures: Path, kind: str) -> None:
    only = {name: float(name == kind) for name in KINDS}
    dataset = SceneSampleDataset([captures], UNNAMED, 5, SampleShares(**only))
    for number in range(4):
        sample = dataset[number]
        classes, known = truths(sample)[0], sample.true_known
        assert known is not None
        assert 0.02 < known.float().mean() < 0.9
        assert bool(known[sample.given > 0].all())
        assert set(classes[known].tolist()) == {FREE, SOLID}
        assert bool((classes[~known] == OUTSIDE).all())
        assert int(sample.action) == 0


def test_fused_cells_are_those_of_the_house_as_far_as_they_are_known(houses: Path, captures: Path) -> None:
    fused, stored = SceneSampleDataset([captures], UNNAMED, 0), SceneSampleDataset([houses], WINDOW, 0)
    for capture, house in zip(fused.files, stored.files, strict=True):
        seen, whole = fused.truths.at(capture, 0), house.cells(0)
        true = whole.box(seen.corner, seen.shape)
        agree = (seen.solid == true.solid)[seen.known & true.known]
        assert int(seen.known.sum()) > 1000
        assert float(agree.float().mean()) > 0.97
        assert fused.truths.floor(capture, 0) == stored.truths.floor(house, 0) == 0


def test_a_capture_without_depth_is_refused(tmp_path: Path) -> None:
    blind = [replace(frame, depth=np.zeros_like(frame.depth)) for frame in make_frames(4)]
    write_trajectory(tmp_path / "one.parquet", INFO, blind)
    form = replace(UNNAMED, image=(INFO.height, INFO.width))
    with pytest.raises(DataError, match=r"one\.parquet: no frame has depth, so that nothing is known of its cells"):
        SceneSampleDataset([tmp_path], form, 0)[0]


@pytest.mark.parametrize(
    ("form", "cause"),
    [
        (replace(WINDOW, image=(64, 64)), "images are 32x32, the scene model takes 64x64"),
        (replace(WINDOW, cells=CellForm(0.5, FORM.palette)), "its cells of 0.25 m .* are not those of the scene model"),
    ],
)
def test_data_of_another_form_are_refused(houses: Path, form: SceneForm, cause: str) -> None:
    with pytest.raises(DataError, match=rf"house-9001\.parquet: {cause}"):
        SceneSampleDataset([houses], form, 0)


def test_samples_are_drawn_in_every_kind(houses: Path) -> None:
    dataset = SceneSampleDataset([houses], WINDOW, 1)
    actions = np.array([int(dataset[number].action) for number in range(40)])
    assert 0 < (actions > 0).mean() < 0.5


def test_kinds_are_drawn_as_often_as_their_shares_say(houses: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []
    for kind in KINDS:
        monkeypatch.setattr(SceneSampleDataset, f"_{kind}", lambda _, random, name=kind: drawn.append(name))
    monkeypatch.setattr(SceneSampleDataset, "_sample", lambda *_: None)
    dataset = SceneSampleDataset([houses], WINDOW, 1, SampleShares(frame=0.6, walk=0.0, grown=0.1, interaction=0.1))
    for number in range(400):
        _ = dataset[number]
    counts = {kind: drawn.count(kind) / 400 for kind in KINDS}
    assert counts == pytest.approx({"frame": 0.75, "walk": 0.0, "grown": 0.125, "interaction": 0.125}, abs=0.06)


@pytest.mark.parametrize(("idle", "events"), [(0.0, 1.0), (1.0, 0.0), (0.2, 0.8)])
def test_interactions_find_nothing_to_act_on_as_often_as_the_share_says(
    houses: Path, monkeypatch: pytest.MonkeyPatch, idle: float, events: float
) -> None:
    dataset, drawn = samples_of(houses, "interaction", idle=idle), []
    monkeypatch.setattr(dataset, "_event", lambda *_: drawn.append(1.0))
    monkeypatch.setattr(dataset, "_idle", lambda *_: drawn.append(0.0))
    for number in range(200):
        dataset._interaction(np.random.default_rng(number))
    assert np.mean(drawn) == pytest.approx(events, abs=0.08)


def test_trajectories_of_one_length_offer_other_frames(houses: Path) -> None:
    dataset = samples_of(houses, "walk")
    first, second = ([dataset._frames(file, state) for state in range(2 * FIXED)] for file in dataset.files)
    assert len(dataset.files[0]) == len(dataset.files[1])
    assert first != second


def test_walks_of_few_frames_are_as_frequent_as_those_of_many() -> None:
    lengths = np.array([len(_frames_up_to(1000, True, np.random.default_rng(number))) for number in range(400)])
    assert (lengths.min(), lengths.max()) == (2, MOST_FRAMES)
    assert np.mean(lengths <= np.sqrt(2 * MOST_FRAMES)) == pytest.approx(0.5, abs=0.12)
