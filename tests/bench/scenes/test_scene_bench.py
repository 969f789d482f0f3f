"""The benchmark of scenes: its rows and parts, going on where it was stopped, and what it refuses."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from persist_cli.api.actions import walking_actions
from persist_cli.api.cells import Box
from persist_cli.api.ground import Body
from persist_cli.bench.scenes.journal import file_name
from persist_cli.bench.scenes.plan_pictures import class_colors
from persist_cli.bench.scenes.run_scene_bench import against_baselines
from persist_cli.bench.scenes.walk_part import Wanderer, house_shares, new_cells, walk, window_values
from persist_cli.checkpoints.scene_models import find_scene_model
from tests.conftest import Persist
from tests.support.cell_houses import FORM, two_rooms, write_cell_houses
from tests.support.cell_rooms import UP as ROOM_UP
from tests.support.cell_rooms import camera_at, cell_room
from tests.support.drawn_scenes import DrawnWalls, empty_scene
from tests.support.micro_runs import run_persist

SMALL = ("--radius", 2, "--seeds", 2, "--set", "memory.steps=1")
WALKS = ("--walk-steps", 12, "--walks", 1)


@pytest.fixture(scope="module")
def measured(
    scene_model: Path, cell_houses: Path, training_cell_houses: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A finished benchmark of the parts that draw no frames."""
    out = tmp_path_factory.mktemp("bench") / "scenes"
    options = ("--data", cell_houses, "--train", training_cell_houses, "--parts", "completion,walk,speed", "--out", out)
    options = (*options, "--report", out / "report")
    run_persist("bench", "scene", *map(str, (scene_model, *options, *SMALL, *WALKS)))
    return out


def test_every_row_is_compared_with_the_true_cells(measured: Path) -> None:
    part = json.loads((measured / "metrics.json").read_text())["completion"]
    baselines = ["empty", "outside", "class prior", "nearest house", "5 nearest houses"]
    assert [*part["rows"]] == ["model", *baselines, "truth, coded", "truth"]
    means = {name: row["figures"]["miou"]["mean"] for name, row in part["rows"].items()}
    assert means["truth"] == 1.0
    assert means["empty"] == means["outside"] == 0.0
    assert means["nearest house"] > 0.5  # the houses differ in the place of a doorway
    assert part["classes"] == ["floor", "ceiling", "wall"]  # the doorway is farther away
    assert part["rows"]["model"]["seeds"] == 2
    assert part["rows"]["model"]["figures"]["miou"]["differences"].keys() == {*baselines}


def test_a_model_is_compared_with_the_best_row_that_has_no_model_and_no_truth() -> None:
    means = {"model": 0.1, "empty": 0.0, "outside": 0.01, "nearest house": 0.04, "5 nearest houses": 0.08, "truth": 1.0}
    rows = {name: {"figures": {"miou": {"mean": mean}}} for name, mean in means.items()}
    compared = against_baselines({"rows": rows})
    assert compared == {"best_baseline": "5 nearest houses", "ratio": pytest.approx(1.25)}
    del rows["model"]
    assert against_baselines({"rows": rows})["ratio"] is None


def test_the_windows_of_a_model_are_known_without_its_weights(scene_model: Path, tmp_path: Path) -> None:
    trained = find_scene_model(scene_model)
    alone = shutil.copytree(trained.folder, tmp_path / "alone", ignore=shutil.ignore_patterns("*.safetensors"))
    assert find_scene_model(alone).form == trained.load().form


def test_walks_count_what_is_new_in_each_window(measured: Path) -> None:
    windows = json.loads((measured / "metrics.json").read_text())["walk"]["windows"]
    assert [*windows] == ["1-12"]
    assert windows["1-12"]["new"]["mean"] > 0
    assert 0 <= windows["1-12"]["blocked"]["mean"] <= 1
    speed = json.loads((measured / "metrics.json").read_text())["speed"]["rows"]
    cells = [row["cells"]["mean"] for row in speed.values()]
    assert cells == sorted(cells)


def test_tables_say_what_every_row_and_column_means(measured: Path) -> None:
    text = (measured / "tables.md").read_text()
    for words in (
        "| model |",
        "- **nearest house**: the training house",
        "- **mIoU**: mean over",
        "class drift (walk)",
    ):
        assert words in text


def test_the_report_shows_the_plans_of_every_row(measured: Path) -> None:
    page = (measured / "report" / "report.html").read_text()
    for words in ("model, seed 1", "plan: nearest house", "plan: truth", "plan: seen", "Cost of a completion"):
        assert words in page
    for words in ("Along walks in imagined scenes", "<title>share of new cells against steps</title>"):
        assert words in page
    assert "http" not in page.replace("http-equiv", "")  # it needs no other file


@pytest.mark.parametrize("number", [0, 1, 2, 15])
def test_no_thing_of_a_plan_has_nearly_the_colour_of_a_door(number: int) -> None:
    door, *things = class_colors(["door", *(f"thing {n}" for n in range(number))]).int()
    assert all((thing - door).abs().max() > 60 for thing in things)


def test_a_stopped_benchmark_goes_on_and_gives_the_same(
    persist: Persist, measured: Path, scene_model: Path, cell_houses: Path, training_cell_houses: Path
) -> None:
    before = json.loads((measured / "metrics.json").read_text())
    kept = next((measured / "parts").glob("model*"))
    times = {path.name: path.stat().st_mtime_ns for path in kept.iterdir()}
    first = min(times)
    (kept / first).unlink()
    options = ("--data", cell_houses, "--train", training_cell_houses, "--parts", "completion", "--out", measured)
    result = persist("bench", "scene", scene_model, *options, *SMALL, "--json")
    assert result.code == 0, result.err
    again = json.loads(result.out)["completion"]["rows"]["model"]["class_iou"]
    assert again == before["completion"]["rows"]["model"]["class_iou"]
    assert all((kept / name).stat().st_mtime_ns == time for name, time in times.items() if name != first)


def test_parts_rows_and_seeds_are_added_to_a_finished_benchmark(
    persist: Persist, measured: Path, scene_model: Path, cell_houses: Path, training_cell_houses: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    small = ("--data", cell_houses, "--out", out, *SMALL)
    for words in (small, (scene_model, *small, "--seeds", 1)):
        run_persist("bench", "scene", *map(str, (*words, "--parts", "completion")))
    kept = {path: path.stat().st_mtime_ns for path in (out / "parts").glob("empty*/*")}
    more = ("--train", training_cell_houses, "--parts", "completion,walk", *WALKS)
    assert persist("bench", "scene", scene_model, *small, *more).code == 0
    assert kept == {path: path.stat().st_mtime_ns for path in kept}
    added, whole = (json.loads((folder / "metrics.json").read_text()) for folder in (out, measured))
    for row, part in whole["completion"]["rows"].items():
        assert added["completion"]["rows"][row]["class_iou"] == part["class_iou"]
    assert added["walk"]["windows"]["1-12"]["new"]["mean"] > 0
    result = persist("bench", "scene", scene_model, *small, *more, "--walk-steps", 13)
    assert "holds 'walk' of another benchmark" in result.err


def test_what_does_not_fit_is_refused_in_one_line(
    persist: Persist, walks: Path, cell_houses: Path, scene_model: Path, measured: Path, tmp_path: Path
) -> None:
    same = write_cell_houses(tmp_path / "test", [5])
    wrong = (
        (("--parts", "compeltion"), "completion"),
        (("--parts", ","), "--parts names nothing to measure"),
        (("--radius", "inf"), "--radius inf: metres, 50 at most"),
        (("--parts", "walk"), "needs a scene model"),
        (("--parts", "edits"), "--checkpoint"),
        ((*WALKS, "--parts", "completion"), "--walk-steps: only with --parts walk"),
        (("--edits", 3, "--parts", "return"), "--edits: only with --parts edits"),
        (("--seeds", 3, "--parts", "edits"), "--seeds: only with --parts completion or walk or return or evolution"),
        (
            ("--parts", "edits", "--dtype", "float32", "--denoising-steps", 2),
            "--denoising-steps, --dtype: only with --checkpoint",
        ),
        (("--guidance", 2, "--parts", "walk"), "--guidance: only with --parts return or edits"),
        (("--train", same, "--parts", "walk"), "--train: only with --parts completion"),
        (("--houses", 3), "--houses: only with --train"),
        (("--train", same), "is measured, too"),
        (("--data", walks), "no cells"),
        ((tmp_path,), str(tmp_path)),
        (("--radius", 3, "--out", measured), "another benchmark"),
    )
    for options, cause in wrong:
        given = () if "--data" in options else ("--data", cell_houses)
        result = persist("bench", "scene", *given, "--out", tmp_path / "out", *options)
        assert (result.code, cause in result.err, len(result.err.strip().splitlines())) == (1, True, 1), result.err
    assert not (tmp_path / "out").exists()


def test_every_name_has_a_file_of_its_own_in_the_journal() -> None:
    names = ("return scene", "return-scene", "return scene, true grid", "return scene-true-grid", "Return scene")
    assert len({file_name(name) for name in names}) == len(names)


def test_an_agent_that_is_stopped_turns_before_it_goes_on() -> None:
    wanderer = Wanderer(walking_actions(), np.random.default_rng(0))
    assert [wanderer.next(False) for _ in range(3)] == ["forward"] * 3
    turn = wanderer.next(True)
    assert turn in ("left", "right")
    rest = [wanderer.next(False) for _ in range(12)]
    assert rest[-1] == "forward"
    assert set(rest[: rest.index("forward")]) <= {turn}


def test_the_figures_of_a_window_are_of_its_new_cells_and_of_the_steps_ahead() -> None:
    window = {"new": [6, 0, 2, 0, 2], "agreement": [[0, 0, 0]] * 6, "tried": 4, "refused": 1}
    figures = window_values(window | {"steps": 10, "metres": 0.75, "seconds": 5.0}, np.array([0.5, 0.0, 0.3, 0.0, 0.2]))
    assert figures == pytest.approx(
        {"new": 10, "occupied": 0.2, "free": 0.6, "drift": 0.1, "miou": float("nan"), "blocked": 0.25, "metres": 0.75,
         "seconds": 0.5}, nan_ok=True,
    )  # fmt: skip


def test_new_cells_agree_or_not_only_where_the_true_house_knows_them() -> None:
    house, before, after = two_rooms(), two_rooms(), two_rooms()
    house.origins[20:], before.origins[10:] = 0, 0
    found = new_cells(before, after, SimpleNamespace(house=house))
    assert sum(found["new"]) == int(after.known[10:].sum())
    assert np.array(found["agreement"])[:-1].sum(0).tolist() == [int(house.known[10:20].sum())] * 3
    shares = house_shares([SimpleNamespace(house=house)], len(FORM.palette))
    counts = torch.bincount(house.classes[:20].flatten().long(), minlength=len(FORM.palette)).numpy()
    assert shares == pytest.approx(counts / counts.sum())


def test_a_step_that_a_wall_stops_counts_for_no_metres() -> None:
    scene, grid = empty_scene(DrawnWalls()), cell_room()
    scene.add(grid)
    info = SimpleNamespace(world_up=ROOM_UP, vocabulary=walking_actions())
    frame = SimpleNamespace(cameras=camera_at(grid, (2, 2, 5), (9, 2, 5)))
    region = SimpleNamespace(box=lambda truth: Box((-0.2, 0.5, -0.2), (0.2, 1.0, 0.2)))
    view = SimpleNamespace(info=info, frame=frame, region=region, truth=grid, house=grid)
    scenes = SimpleNamespace(seeded=lambda seed: SimpleNamespace(after=lambda view: scene))
    bench = SimpleNamespace(scenes=scenes, body=lambda view: Body(), plan=SimpleNamespace(steps=30))
    [window] = walk(bench, view, 0)
    assert 0 < window["refused"] < window["tried"]
    assert window["metres"] == pytest.approx(0.25 * (window["tried"] - window["refused"]))
