"""The true scene of a collected trajectory, found again."""

import json
from dataclasses import replace

import numpy as np
import pytest

from persist_cli.data.store import TrajectoryFile, write_trajectory
from persist_cli.planning.true_futures import true_futures
from tests.support.miniworlds import make_world, put_somewhere
from tests.support.packages import install


@pytest.fixture
def seen(tmp_path):
    """A trajectory of two frames in a house, by an agent that is not the default one."""
    world = make_world(height=32, width=32, step=0.3, turn=20.0, camera_height=1.0, fov=60.0)
    world.open_scene(5)
    put_somewhere(world)
    first = replace(world.observe(), action="left")
    assert world.act("left")
    info = replace(world.info, source=world.info.source | {"camera": {"fov": 60.0, "camera_height": 1.0}})
    write_trajectory(tmp_path / "house.parquet", info, [first, world.observe()])
    return TrajectoryFile(tmp_path / "house.parquet").read()


def test_the_true_scene_shows_the_frame_that_was_recorded(seen):
    futures, unknown = true_futures(seen.observations[:1], seen.info)
    assert (unknown, futures is None) == ("", False)
    truth = futures.imagine([["left"]], "last").futures.rgb[0, 0]
    assert np.abs(truth.numpy().astype(int) - seen.observations.rgb[1].numpy()).mean() < 1


def test_a_true_cost_that_is_nan_is_said_and_no_empty_column(seen, persist, voxel, site, tmp_path):
    once = """
        import torch
        from persist_cli.api.cost import Cost

        class Once(Cost):
            reads, sees, calls = "place", False, 0
            def measure(self, futures, goal, ground):
                Once.calls += 1  # the first batch is imagined, the second one is true
                return torch.full(futures.free.shape, 1.0 if Once.calls == 1 else torch.nan)
    """
    install(site, "persist-once", "persist.costs", "once = once:Once", once)
    small = ("--steps", 1, "--candidates", 4, "--rounds", 1, "--horizon", 2, "--cost", "once")
    frames = (f"{tmp_path}#house:0", "--goal", f"{tmp_path}#house:1")
    ended = persist("plan", voxel, "--start", *frames, *small, "--out", tmp_path / "plan")
    assert ended.code == 0, ended.err
    assert "what is really there is left out: its cost 'once' is NaN" in ended.out
    truth = json.loads((tmp_path / "plan/plan.json").read_text())["truth"]
    assert truth == {"known": False, "unknown": "its cost 'once' is NaN"}


@pytest.mark.parametrize(
    ("source", "cause"),
    [
        ({"simulator": None}, "the data is no simulator's"),
        ({"simulator": "minworld"}, "unknown simulator 'minworld'"),
        ({"house": 6}, "the simulator shows another start frame|is not free"),
    ],
)
def test_why_the_truth_is_not_known_is_said(seen, source, cause):
    info = replace(seen.info, source=seen.info.source | source)
    futures, unknown = true_futures(seen.observations[:1], info)
    assert futures is None
    assert any(part in unknown for part in cause.split("|"))
