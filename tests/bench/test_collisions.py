"""The benchmark of collisions counts what the simulator refuses, and refuses what it cannot measure."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from persist_cli.api.ground import Cover
from persist_cli.bench.collisions import cell_verdicts, frame_verdicts, map_verdicts, outcomes, random_walk, row_json
from tests.support.miniworlds import make_world


@pytest.fixture(scope="module")
def walk():
    """A random walk through a held-out house, with the world's own attempts."""
    world = make_world()
    world.open_scene(1_100_000)
    return random_walk(world, np.random.default_rng(3), 24)


@pytest.fixture(scope="module")
def four_walks():
    """Random walks through another held-out house."""
    world = make_world()
    world.open_scene(1_100_001)
    return [random_walk(world, np.random.default_rng(seed), 24) for seed in range(4)]


def test_a_random_walk_is_deterministic_and_tries_no_refused_step_again(walk):
    world = make_world()
    world.open_scene(1_100_000)
    again = random_walk(world, np.random.default_rng(3), 24)
    assert (again.taken, again.attempts) == (walk.taken, walk.attempts)
    assert len(walk.frames) == 25
    refused = [(attempt.frame, attempt.action) for attempt in walk.attempts if not attempt.allowed]
    assert len(refused) == len(set(refused)) > 0


def test_no_step_counts_twice_from_one_pose():
    world = make_world(height=16, width=16)
    world.open_scene(1_000_000)
    for seed in range(8):  # an agent that turns back after it was stopped
        walk = random_walk(world, np.random.default_rng(seed), 24)
        poses = walk.frames.cameras.world_from_camera.mul(1000).round().flatten(1).tolist()
        tried = [(*poses[attempt.frame], attempt.action) for attempt in walk.attempts]
        assert len(tried) == len(set(tried))


def test_what_a_map_of_true_frames_takes_for_blocked_the_simulator_refuses(four_walks):
    both, said, missed, _, _ = sum(outcomes(map_verdicts(walk, walk.frames), walk) for walk in four_walks)
    assert both > 10
    assert both > 5 * said
    assert both > missed


def test_true_cells_miss_next_to_no_step_that_the_simulator_refuses(four_walks):
    both, said, missed, neither, _ = sum(outcomes(cell_verdicts(walk), walk) for walk in four_walks)
    assert both > 10 * missed
    assert both > said
    assert neither > 10


def test_a_verdict_uses_no_frame_that_comes_after_it(walk):
    early = [attempt for attempt in walk.attempts if attempt.frame < 12]
    cut = map_verdicts(walk, walk.frames[:12])[: len(early)]
    assert map_verdicts(walk, walk.frames)[: len(early)] == cut
    assert frame_verdicts(walk, walk.frames)[: len(early)] == frame_verdicts(walk, walk.frames[:12])[: len(early)]


def test_a_verdict_of_a_frame_knows_that_frame_alone_and_one_of_a_map_its_present_frame_too(walk):
    alone = [
        replace(walk, frames=walk.frames[one.frame : one.frame + 1], attempts=(replace(one, frame=0),))
        for one in walk.attempts
    ]
    expected = [map_verdicts(one, one.frames)[0] for one in alone]
    assert frame_verdicts(walk, walk.frames) == expected
    assert len(set(expected)) > 1
    assert map_verdicts(walk, walk.frames) != expected


def test_precision_and_recall_are_shares_of_counted_steps(walk):
    refused = [not attempt.allowed for attempt in walk.attempts]
    perfect = [Cover.OCCUPIED if true else Cover.FREE for true in refused]
    counts = outcomes(perfect, walk)
    assert counts.tolist() == [sum(refused), 0, 0, len(refused) - sum(refused), 0]
    row = row_json("true map", np.array([[3, 1, 1, 5, 0], [0, 0, 2, 8, 4]]))
    assert (row["precision"]["mean"], row["recall"]["mean"], row["steps"]) == (0.75, 0.5, 20)
    assert row["unknown"]["mean"] == 0.2
    assert np.isnan(row["precision"]["low"])  # two scenes are too few for an interval


def test_the_command_writes_a_row_for_each_way_to_know(persist, voxel, tmp_path):
    make_world()  # skips where nothing can be rendered
    options = ("--scenes", "100000:100001", "--walks", 1, "--actions", 8, "--steps", 1, "--out", tmp_path / "c.json")
    result = persist("bench", "collisions", voxel, *options)
    assert result.code == 0, result.err
    rows = json.loads((tmp_path / "c.json").read_text())["rows"]
    models = ["voxel, own map", "voxel, own frame", "voxel, memory", "stage1, own map", "stage1, own frame"]
    assert [row["name"] for row in rows] == ["true map", "true frame", "true cells", *models]
    assert len({row["steps"] for row in rows}) == 1
    for wrong, cause in ((("--memories", "map2d"), "'map2d'"), (("--scenes", "5:5"), "5:5"), (("--split", "x"), "'x'")):
        result = persist("bench", "collisions", voxel, *options, *wrong)
        assert (result.code, cause in result.err, len(result.err.strip().splitlines())) == (1, True, 1), result.err
