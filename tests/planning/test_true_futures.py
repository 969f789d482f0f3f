"""The true scene of a collected trajectory, found again."""

from dataclasses import replace

import numpy as np
import pytest

from persist_cli.data.store import TrajectoryFile, write_trajectory
from persist_cli.planning.true_futures import true_futures
from tests.support.miniworlds import make_world, put_somewhere


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
