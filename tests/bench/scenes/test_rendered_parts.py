"""The parts that draw frames: the same poses there and back, the true grid as the ceiling, and edits that are seen."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from persist_cli.api.cameras import Cameras
from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.api.inference import InferenceOptions, SamplingOverrides
from persist_cli.api.scene_edits import Copy, Move
from persist_cli.bench.scenes import edit_part
from persist_cli.bench.scenes.edit_part import AROUND, MOVED, EditTrial, draw_change, is_visible, judge_edit, shows
from persist_cli.bench.scenes.journal import SceneJournal
from persist_cli.bench.scenes.rendering import RendererLoader, rendered_rows
from persist_cli.bench.scenes.return_part import (
    WINDOW,
    compared_frames,
    first_visit,
    frame_values,
    obstacles,
    psnr,
    true_detail,
    true_pieces,
    walk_values,
    window_figures,
)
from persist_cli.bench.scenes.scene_bench import (
    RenderingPlan,
    SceneBench,
    SceneBenchPlan,
    chosen_files,
    part_identities,
    prepare,
    read_views,
)
from persist_cli.editing.locality import edited_pixels
from persist_cli.evaluate.statistics import Draws
from persist_cli.io.files import read_tensors, write_tensors
from persist_cli.metrics.fvd import LEAST_FRAMES, LEAST_VIDEOS, Fvd
from persist_cli.metrics.fvd_pieces import fvd_of_rows, pieces
from persist_memory.scene.editing import edit_grid
from tests.conftest import Persist
from tests.support.cell_houses import TABLE, camera_in, two_rooms, write_cell_houses
from tests.support.micro_runs import run_persist

SMALL = (
    "--seeds", 1, "--walks", 1, "--return-steps", 9, "--edits", 3, "--denoising-steps", 1, "--radius", 2,
    "--memories", "scene,stage1", "--set", "memory.steps=1",
)  # fmt: skip


@pytest.fixture(scope="module")
def measured(
    scene_model: Path, cell_houses: Path, scene_renderer: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A finished benchmark of the parts that draw frames."""
    out = tmp_path_factory.mktemp("bench") / "rendered"
    options = ("--data", cell_houses, "--parts", "return,edits", "--out", out, "--checkpoint", scene_renderer)
    options = (*options, "--report", out / "report")
    run_persist("bench", "scene", *map(str, (scene_model, *options, *SMALL)))
    return out


def test_a_sampling_that_the_model_cannot_do_is_refused_before_anything_is_measured(
    persist: Persist, cell_houses: Path, scene_renderer: Path, tmp_path: Path
) -> None:
    options = ("--data", cell_houses, "--parts", "completion,edits", "--checkpoint", scene_renderer)
    ended = persist("bench", "scene", *options, "--autoguidance", 3, "--out", tmp_path / "out")
    assert (ended.code, "autoguidance of 3: this checkpoint has no guide" in ended.err) == (1, True), ended.err
    assert not (tmp_path / "out").exists()


def test_ways_there_and_back_are_sampled_as_the_card_says_of_returns_and_edits_are_not(
    cell_houses: Path, scene_renderer: Path, tmp_path: Path
) -> None:
    model = tmp_path / "model"
    run_persist("export", str(scene_renderer), "--out", str(model), "--steps", "2", "--sampling-for", "return:steps=3")
    rendering = RenderingPlan(model, ("scene",), 9, SamplingOverrides(), InferenceOptions())
    plan = SceneBenchPlan(model=None, data=str(cell_houses), train=None, parts=("return", "edits"), rendering=rendering)
    bench = prepare(plan, tmp_path / "out")
    rows = rendered_rows(rendering)
    sampled = {part: RendererLoader(bench, rendering, part).load(rows[0]).sampling.steps for part in plan.parts}
    assert sampled == {"return": 3, "edits": 2}
    said = part_identities(plan, [], None)
    assert {part: said[part]["sampling"]["steps"] for part in plan.parts} == sampled


def test_the_way_back_has_the_poses_of_the_way_out(measured: Path) -> None:
    walk = read_tensors(next((measured / "parts").glob("return-scene-true-grid*/*")))[0]
    out, frames = int(walk["out"]), len(walk["poses"])
    assert frames == 2 * out - 1
    for frame in range(out, frames):
        assert torch.equal(walk["poses"][frame], walk["poses"][first_visit(frame, out)])


def test_each_memory_is_a_row_and_a_scene_has_one_with_true_cells(measured: Path) -> None:
    part = json.loads((measured / "metrics.json").read_text())["return"]
    assert [*part["rows"]] == ["scene", "scene, true grid", "stage1"]
    assert part["rows"]["scene"]["sharpness"]["mean"] > 0
    assert [*part["windows"]] == [*part["rows"]]
    page = (measured / "report" / "report.html").read_text()
    assert "Along walks there and back" in page
    assert page.count('class="line row-2"') == 2  # sharpness and PSNR of the third row


def test_a_walk_that_fades_shows_in_the_worst_window_and_in_a_line_that_falls() -> None:
    draw = torch.Generator().manual_seed(0)
    rgb = torch.randint(0, 255, (2 * WINDOW + 1, 16, 16, 3), generator=draw, dtype=torch.uint8)
    rgb[WINDOW + 1 :] = 128
    walk = {"rgb": rgb, "poses": torch.eye(4).expand(len(rgb), 4, 4), "out": torch.tensor(WINDOW + 1)}
    seen = frame_values(walk, 4, true_detail([rgb[: WINDOW + 1]]))
    short = {name: values[:10] for name, values in seen.items()}
    windows, worst = window_figures([[seen, short]], Draws.of([0, 1]))
    assert [*windows] == [f"1-{WINDOW}", f"{WINDOW + 1}-{2 * WINDOW}"]
    sharp = [window["sharpness"]["mean"] for window in windows.values()]
    assert sharp == pytest.approx([1.0, 0.0], abs=0.1)
    assert worst["mean"] == pytest.approx(sharp[1])
    assert windows[f"1-{WINDOW}"]["psnr"]["mean"] is None  # on the way out there is nothing to compare with
    whole = walk_values(walk | {"seconds": torch.tensor(1.0)}, seen, 4)
    assert windows[f"{WINDOW + 1}-{2 * WINDOW}"]["psnr"]["mean"] == pytest.approx(whole["psnr"])


def test_frames_of_an_adapter_that_was_trained_on_are_not_taken_for_those_of_the_new_one(
    persist: Persist, measured: Path, scene_model: Path, cell_houses: Path, scene_renderer: Path, tmp_path: Path
) -> None:
    trained = shutil.copytree(scene_renderer, scene_renderer.with_name(f"{scene_renderer.name}-trained-on"))
    weights = find_checkpoint(trained).adapter_folder("scene") / "adapter.safetensors"
    tensors, metadata = read_tensors(weights)
    write_tensors(weights, {name: tensor + 1 for name, tensor in tensors.items()}, metadata)
    out = shutil.copytree(measured, tmp_path / "out")
    options = ("--data", cell_houses, "--parts", "return,edits", "--out", out, "--checkpoint", trained, *SMALL)
    result = persist("bench", "scene", scene_model, *options)
    assert "holds 'adapter scene' of another benchmark" in result.err


def test_edits_are_rendered_and_counted_by_kind(measured: Path) -> None:
    part = json.loads((measured / "metrics.json").read_text())["edits"]
    assert part["adapter"] == "scene"
    assert "Random edits, drawn by 'scene'" in (measured / "tables.md").read_text()
    assert part["wanted"] == 3
    assert part["rows"]["all"]["count"] == sum(row["count"] for name, row in part["rows"].items() if name != "all") > 0
    assert part["rows"]["all"]["outside"]["mean"] >= 0
    assert 0 <= part["rows"]["all"]["local"]["mean"] <= 1
    tables = (measured / "tables.md").read_text()
    assert "| local ↑ |" in tables[tables.index("Random edits") :]


@pytest.mark.parametrize(("kind", "edit", "tables"), [("move", Move, 8), ("copy", Copy, 16)])
def test_a_thing_is_moved_or_copied_over_the_ground_by_a_metre_or_so(kind: str, edit: type, tables: int) -> None:
    house = two_rooms()
    house.classes[9:11, 7:9, 1:3] = TABLE
    lens = torch.tensor([[16.0, 0, 16], [0, 16, 16], [0, 0, 1]])
    camera = Cameras(camera_in(house)[None], lens[None], 32, 32)
    drawn = [draw_change(kind, house, camera, np.random.default_rng(seed)) for seed in range(20)]
    for change in drawn:
        assert isinstance(change, edit)
        assert MOVED[0] <= math.hypot(change.by[0], change.by[2]) <= MOVED[1]
        assert change.by[1] == pytest.approx(0)
    near = min(drawn, key=lambda change: change.by[0])  # towards the camera, where the room is free
    assert int((edit_grid(house, [near], None)[0].classes == TABLE).sum()) == tables


def test_an_edit_is_measured_where_the_last_camera_sees_it_and_the_given_one_does_not() -> None:
    house, edited = two_rooms(), two_rooms()
    edited.classes[9:11, 7:9, 1:3] = TABLE
    lens = torch.tensor([[16.0, 0, 16], [0, 16, 16], [0, 0, 1]])
    ahead, back = (Cameras(camera_in(house, quarter=quarter)[None], lens[None], 32, 32) for quarter in (0, 2))
    assert is_visible(house, edited, back, ahead)
    assert not is_visible(house, edited, ahead, ahead)
    assert not is_visible(house, edited, back, back)


def test_an_edit_is_there_where_the_picture_is_more_like_the_cells_after_it() -> None:
    before, after, picture = (torch.full((1, 2, 2, 3), shade, dtype=torch.uint8) for shade in (0, 200, 150))
    mask = torch.ones(1, 2, 2, dtype=torch.bool)
    assert shows(picture, [before, after], mask)
    assert not shows(picture, [after, before], mask)


def test_frames_of_one_clip_are_not_compared_with_each_other() -> None:
    rgb = torch.randint(0, 255, (9, 16, 16, 3), dtype=torch.uint8)
    walk = {"rgb": rgb, "poses": torch.eye(4).expand(9, 4, 4), "out": torch.tensor(5), "seconds": torch.tensor(2.0)}
    assert math.isnan(walk_values(walk, frame_values(walk, 8, 1.0), 8)["psnr"])
    assert math.isfinite(walk_values(walk, frame_values(walk, 4, 1.0), 4)["psnr"])
    same = walk | {"rgb": torch.cat([rgb[:5], rgb[:4].flip(0)])}
    assert walk_values(same, frame_values(same, 4, 1.0), 4)["psnr"] == 100.0


def test_without_true_frames_there_is_no_sharpness_and_no_fvd() -> None:
    rgb = torch.randint(0, 255, (33, 32, 32, 3), dtype=torch.uint8)
    walk = {"rgb": rgb, "poses": torch.eye(4).expand(33, 4, 4), "out": torch.tensor(17), "seconds": torch.tensor(2.0)}
    assert math.isnan(walk_values(walk, frame_values(walk, 4, true_detail([])), 4)["sharpness"])
    assert math.isnan(fvd_of_rows({"voxel": pieces(rgb)}, [])["voxel"])
    assert any("has more than 16 frames, so no sharpness and no FVD" in reason for reason in obstacles([]))


def test_fvd_takes_as_many_pieces_of_each_row_as_there_are_true_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Fvd, "features", lambda self, rgb: rgb.double().mean((1, 2)).flatten())
    draw, size = torch.Generator().manual_seed(0), (LEAST_VIDEOS, LEAST_FRAMES, 32, 32, 3)
    true = list(torch.randint(0, 255, size, generator=draw, dtype=torch.uint8))
    twice = [piece for piece in true for _ in range(2)]
    scale = float(Fvd().features(true[0]).square().sum())  # zero is rounded
    assert fvd_of_rows({"twice": twice}, true)["twice"] < 1e-12 * scale


def test_houses_seen_in_few_frames_have_no_true_pieces(tmp_path: Path) -> None:
    data = write_cell_houses(tmp_path / "short", [5], frames=16)
    plan = SceneBenchPlan(model=None, data=str(data), train=None, parts=("return",), radius=2)
    bench = SceneBench(
        plan=plan, views=read_views(chosen_files(plan), plan), houses=[], journal=SceneJournal(tmp_path / "out")
    )
    assert true_pieces(bench) == []


def test_psnr_is_that_of_the_mean_squared_error() -> None:
    black, grey = torch.zeros(1, 4, 4, 3, dtype=torch.uint8), torch.full((1, 4, 4, 3), 51, dtype=torch.uint8)
    assert float(psnr(black, grey)) == pytest.approx(20 * math.log10(255 / 51))


def test_a_walk_is_as_long_as_its_way_out_and_only_frames_of_other_clips_are_compared() -> None:
    rgb = torch.randint(0, 255, (9, 16, 16, 3), dtype=torch.uint8)
    poses = torch.eye(4).repeat(9, 1, 1)
    poses[:, 0, 3] = torch.tensor([0.0, 0.5, 1.0, 1.5, 2.0, 1.5, 1.0, 0.5, 0.0])
    walk = {"rgb": rgb, "poses": poses, "out": torch.tensor(5), "seconds": torch.tensor(2.0)}
    assert compared_frames(walk, 4) == ([7, 8], [1, 0])
    seen = frame_values(walk, 4, 1.0)
    assert np.isfinite(seen["sharpness"]).tolist() == [False] + [True] * 8  # the first frame is given
    assert walk_values(walk, seen, 4)["metres"] == 2.0


def test_pieces_of_a_walk_begin_after_the_given_frame() -> None:
    rgb = torch.arange(2 * LEAST_FRAMES + 1, dtype=torch.uint8)[:, None, None, None].expand(-1, 2, 2, 3)
    firsts = [int(piece[0, 0, 0, 0]) for piece in pieces(rgb)]
    assert (firsts, {len(piece) for piece in pieces(rgb)}) == ([1, LEAST_FRAMES + 1], {LEAST_FRAMES})
    assert len(pieces(rgb[:-1])) == 1


def test_what_changes_right_beside_an_edit_is_no_change_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    house, edited = two_rooms(), two_rooms()
    edited.classes[9:11, 7:9, 1:3] = TABLE
    lens = torch.tensor([[16.0, 0, 16], [0, 16, 16], [0, 0, 1]])
    camera = Cameras(camera_in(house)[None], lens[None], 32, 32)
    before, after = (SimpleNamespace(cells=grid, copy=lambda: None) for grid in (house, edited))
    trial = EditTrial(SimpleNamespace(scene="house"), camera, before, after, "insert")
    rim = edited_pixels(house, edited, camera, AROUND) & ~edited_pixels(house, edited, camera)
    frames = [torch.zeros(1, 32, 32, 3, dtype=torch.uint8) for _ in range(3)]
    frames[1][rim] = frames[2][rim] = 200
    drawn = iter(frames)
    monkeypatch.setattr(edit_part, "rendered", lambda *arguments: next(drawn))
    judged = judge_edit(None, None, trial, 0)
    assert int(rim.sum()) > 20
    assert (judged["outside"], judged["noise"]) == (0.0, 0.0)
