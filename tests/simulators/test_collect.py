"""Collecting is repeatable, can be stopped at any time, and keeps splits apart."""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
import torch

from persist_cli.data.store import Store
from persist_cli.errors import DataError, PersistError
from persist_cli.navigation.ground_mapper import body_of
from persist_cli.planning.true_futures import simulator_settings
from persist_cli.simulators.collect import (
    FIRST_SEED,
    SPLIT_SCENES,
    CollectPlan,
    claim_folder,
    run_collect,
    usable_cores,
)
from tests.support.miniworlds import make_world

SMALL = CollectPlan(simulator="miniworld", scenes="0:3", frames=6, size="16x24")
FIVE = CollectPlan(simulator="miniworld", scenes="0:5", frames=12, size="32x32")
COMMAND = "collect miniworld --scenes 0:5 --frames 12 --size 32x32 --workers"


def persist(arguments: str, out: Path) -> subprocess.Popen[str]:
    command = [str(Path(sys.executable).with_name("persist")), *arguments.split(), "--out", str(out)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, text=True, start_new_session=True, **pipes)  # type: ignore[call-overload,no-any-return]


def start_and_wait_for_a_scene(out: Path) -> subprocess.Popen[str]:
    """A run of sixty scenes that has finished its first."""
    process = persist(COMMAND.replace("0:5", "0:60") + " 1", out)
    while process.poll() is None and not list(out.glob("house-*.parquet")):
        time.sleep(0.05)
    assert process.poll() is None, process.communicate()
    return process


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    make_world()  # skips where nothing can be rendered
    out = tmp_path_factory.mktemp("collected")
    run_collect(SMALL, out, 1, json=True)
    return out


def test_a_collected_trajectory_reads_back_with_the_options_of_its_plan(collected: Path) -> None:
    store = Store(collected)
    trajectory = store[2].read()
    assert store.names == ["house-000000", "house-000001", "house-000002"]
    assert trajectory.observations.rgb.shape == (6, 16, 24, 3)
    assert trajectory.info.scene == "miniworld/house-2"
    assert trajectory.info.source["split"] == "train"


def test_collecting_again_changes_nothing(collected: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = contents(collected)
    run_collect(SMALL, collected, 1, json=True)
    assert contents(collected) == before
    assert json.loads(capsys.readouterr().out)["new_trajectories"] == 0


def test_scenes_can_be_added_to_a_folder_later(
    collected: Path, collecting_here: None, capsys: pytest.CaptureFixture[str]
) -> None:
    run_collect(replace(SMALL, scenes="1:4"), collected, 1, json=True)
    figures = json.loads(capsys.readouterr().out)
    assert (figures["trajectories"], figures["new_trajectories"], figures["frames"]) == (3, 1, 18)
    assert len(Store(collected)) == 4


def test_each_scene_draws_its_own_camera_steps_and_turns(tmp_path: Path, collecting_here: None) -> None:
    make_world()
    plan = replace(SMALL, fov="45:90", height="0.6:1.7", pitch="-25:10", turn="5:20", step="0.05:0.3")
    run_collect(plan, tmp_path, 1, json=True)
    infos = [file.info for file in Store(tmp_path)]
    assert len({float(info.intrinsics[0, 0]) for info in infos}) == 3
    assert len({info.vocabulary["forward"].forward for info in infos}) == 3
    for info, file in zip(infos, Store(tmp_path), strict=True):
        camera = info.source["camera"]
        assert 12 / math.tan(math.radians(camera["fov"] / 2)) == pytest.approx(1.5 * info.intrinsics[1, 1])
        assert file.poses()[:, 1, 3].tolist() == pytest.approx([camera["camera_height"]] * 6)
        assert float(file.poses()[0, 1, 2]) == pytest.approx(math.sin(math.radians(camera["pitch"])))


def test_further_settings_reach_the_simulator_and_what_opens_the_scene_again(
    tmp_path: Path, collecting_here: None
) -> None:
    make_world()
    run_collect(replace(SMALL, scenes="0:1", settings={"radius": 0.15}), tmp_path, 1, json=True)
    info = Store(tmp_path)[0].info
    assert info.source["camera"] == {"radius": 0.15}
    assert (body_of(info).radius, simulator_settings("miniworld", info)["radius"]) == (0.15, 0.15)


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"radius": 9}, "radius 9.* is not between"), ({"radios": 0.15}, "did you mean 'radius'"),
     ({"fov": 60}, "--set fov: give --fov"), ({"height": 60}, "--set height: give --size"),
     ({"camera_height": 1}, "--set camera_height: give --height")],
)  # fmt: skip
def test_a_setting_that_is_none_or_has_an_option_is_refused(
    tmp_path: Path, settings: dict[str, object], message: str
) -> None:
    with pytest.raises(PersistError, match=message) as caught:
        run_collect(replace(SMALL, settings=settings), tmp_path / "out", 1, json=False)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_a_scene_has_the_same_camera_whichever_process_collects_it(
    tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    make_world()
    plan = replace(SMALL, fov="45:90", turn="5:20", light="0.6:1.2", tint="0.2", depth_sensor="kinect")
    run_collect(replace(plan, scenes="2:3"), tmp_path / "two", 1, json=True)
    request.getfixturevalue("collecting_here")
    run_collect(plan, tmp_path / "one", 1, json=True)
    name = "house-000002.parquet"
    assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


def test_one_value_in_place_of_a_range_changes_no_byte(collected: Path, tmp_path: Path, collecting_here: None) -> None:
    run_collect(replace(SMALL, scenes="0:1", fov="75", height="1.25", pitch="0"), tmp_path, 1, json=True)
    before, after = (Store(folder)[0].read() for folder in (collected, tmp_path))
    assert torch.equal(before.observations.rgb, after.observations.rgb)
    assert torch.equal(before.observations.depth, after.observations.depth)
    assert before.info.vocabulary == after.info.vocabulary


def test_a_folder_collected_before_there_were_ranges_goes_on(tmp_path: Path) -> None:
    claim_folder(SMALL, tmp_path)
    stored = json.loads((tmp_path / "collect.json").read_text())
    assert set(stored) == {"version", "simulator", "frames", "size", "seed", "split", "policy", "step", "turn"}
    assert (stored["step"], stored["turn"]) == (0.25, 15.0)
    claim_folder(SMALL, tmp_path)


def test_no_two_splits_share_a_seed() -> None:
    every = {split: replace(SMALL, split=split, scenes=f"0:{SPLIT_SCENES}").generator_seeds for split in FIRST_SEED}
    assert sorted(every) == ["test", "train", "validation"]
    ranges = sorted((min(seeds), max(seeds)) for seeds in every.values())
    assert all(last < first for (_, last), (first, _) in pairwise(ranges))
    with pytest.raises(DataError, match="a split has 1000000 scenes"):
        _ = replace(SMALL, scenes=f"0:{SPLIT_SCENES + 1}").generator_seeds


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"split": "test"}, "was collected with split 'train', not 'test'"),
        ({"turn": "10"}, "was collected with turn 15.0, not 10.0"),
        ({"fov": "45:90"}, r"was collected with fov None, not \[45.0, 90.0\]"),
        ({"depth_sensor": "kinect"}, "was collected with depth_sensor 'exact', not 'kinect'"),
        ({"seed": 3}, "was collected with seed 0, not 3"),
        ({"policy": "path"}, "was collected with policy 'explore', not 'path'"),
        ({"settings": {"radius": 0.15}}, r"was collected with settings \{\}, not \{'radius': 0.15\}"),
    ],
)
def test_a_folder_collected_with_other_options_is_refused(
    tmp_path: Path, change: dict[str, object], message: str
) -> None:
    claim_folder(SMALL, tmp_path)
    with pytest.raises(DataError, match=message):
        claim_folder(replace(SMALL, **change), tmp_path)  # type: ignore[arg-type]


def test_a_folder_of_trajectories_that_were_not_collected_is_refused(tmp_path: Path) -> None:
    (tmp_path / "kitchen.parquet").touch()
    with pytest.raises(DataError, match="did not write"):
        claim_folder(SMALL, tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        {"scenes": "3:1"},
        {"scenes": "5"},
        {"scenes": "-1:4"},
        {"size": "64"},
        {"size": "0x64"},
        {"policy": "fly"},
        {"split": "val"},
        {"seed": -1},
        {"simulator": "minworld"},
        {"step": "0:0.3"},
        {"turn": "5:270"},
        {"tint": "-0.5:0"},
        {"depth_sensor": "lidar"},
        {"depth_sensor": "kinect", "size": "1x16"},
    ],
)
def test_bad_options_are_reported_in_one_line_and_write_nothing(tmp_path: Path, change: dict[str, object]) -> None:
    out = tmp_path / "out"
    with pytest.raises(PersistError) as caught:
        run_collect(replace(SMALL, **change), out, 1, json=False)  # type: ignore[arg-type]
    assert len(str(caught.value).splitlines()) == 1
    assert str(next(iter(change.values()))) in str(caught.value)
    assert not out.exists()


def test_a_camera_that_the_simulator_does_not_allow_is_refused_by_the_name_of_its_setting(tmp_path: Path) -> None:
    with pytest.raises(PersistError, match=r"fov 170\.0 is not between 10 and 150 degrees"):
        run_collect(replace(SMALL, fov="45:170"), tmp_path / "out", 1, json=False)


def test_a_killed_run_that_is_repeated_ends_as_an_uninterrupted_one(tmp_path: Path, collecting_here: None) -> None:
    make_world()
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    run_collect(FIVE, whole, 1, json=True)
    process = persist(f"{COMMAND} 2", killed)
    while process.poll() is None and not (len(list(killed.glob("house-*"))) > 1 and list(killed.glob(".partial-*"))):
        time.sleep(0.005)
    workers = children(process.pid)
    process.kill()  # some are whole, another is not
    assert process.wait() == -signal.SIGKILL
    while any(map(is_running, workers)):  # they end by themselves, and may begin another file before
        time.sleep(0.005)
    assert 1 < len(list(killed.glob("house-*"))) < 5
    run_collect(FIVE, killed, 1, json=True)
    assert contents(killed) == contents(whole)


def test_what_another_command_collects_into_the_folder_is_left_alone(
    collected: Path, tmp_path: Path, collecting_here: None
) -> None:
    out = tmp_path / "out"
    shutil.copytree(collected, out)
    (out / "house-000001.parquet").unlink()
    for number in range(4):
        (out / f".partial-0123abcd-house-{number:06d}.parquet").touch()
    run_collect(SMALL, out, 1, json=True)
    left = {path.name[-14:-8] for path in out.glob(".partial-*")}
    assert left == {"000000", "000002", "000003"}
    assert (out / "house-000001.parquet").read_bytes() == (collected / "house-000001.parquet").read_bytes()
    run_collect(SMALL, out, 1, json=True)  # nothing is missing
    assert len(list(out.glob(".partial-*"))) == 3


def children(pid: int) -> list[int]:
    listing = subprocess.run(["ps", "ww", "-o", "pid=,args=", "--ppid", str(pid)], capture_output=True, text=True)
    workers = [line.split()[0] for line in listing.stdout.splitlines() if "spawn_main" in line]
    return [int(worker) for worker in workers]


def is_running(pid: int) -> bool:
    state = subprocess.run(["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True).stdout.strip()
    return bool(state) and not state.startswith("Z")


def test_a_worker_that_dies_is_reported_in_one_line(tmp_path: Path) -> None:
    make_world()
    process = start_and_wait_for_a_scene(tmp_path)
    os.kill(children(process.pid)[0], signal.SIGKILL)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 1
    assert err.strip().splitlines()[-1].startswith("error: a worker process died")
    assert "Traceback" not in err


def test_an_interrupt_ends_quietly_and_leaves_whole_files(tmp_path: Path) -> None:
    make_world()
    process = start_and_wait_for_a_scene(tmp_path)
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert err.strip().splitlines()[-1].startswith("stopped; what is written is whole")
    assert "Traceback" not in err
    assert all(trajectory.length == 12 for trajectory in Store(tmp_path))
    assert not list(tmp_path.glob(".partial-*"))


def test_a_process_that_may_use_one_core_starts_one_worker(monkeypatch):
    if hasattr(os, "sched_getaffinity"):
        allowed = os.sched_getaffinity(0)
        os.sched_setaffinity(0, {min(allowed)})
        try:
            assert usable_cores() == 1
        finally:
            os.sched_setaffinity(0, allowed)
        monkeypatch.delattr(os, "sched_getaffinity")
    assert usable_cores() == os.cpu_count()
