"""The camera's motion as generated frames show it, against the motion asked for, in a furnished room."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from persist_cli.api.geometry import small_motions
from persist_cli.api.observations import Observations
from persist_cli.metrics import METRICS
from persist_cli.metrics.odometry import camera_motions
from tests.support.predictions import observe_room, prediction, setup
from tests.support.rooms import Room, look

TURNED, MOVED = METRICS["rot-error"], METRICS["trans-error"]

ROOM = Room(64, 64)


def turns(*degrees: float) -> np.ndarray:
    """Poses of a camera that turns in the middle of the room."""
    return np.stack([look((0.0, 1.3, 0.2), yaw, 0.0) for yaw in degrees])


def seen(poses: np.ndarray) -> Observations:
    """The room's views from these poses."""
    return observe_room(poses, ROOM)


@pytest.mark.parametrize("step", [0.0, 7.0, 15.0, -22.0, 30.0])
def test_frames_that_turn_as_was_asked_have_almost_no_error(step):
    truth = seen(turns(0.0, step, 2 * step))
    shown = prediction(truth.rgb, truth.depth, truth)
    assert TURNED.measure(shown).isnan().tolist() == [True, False, False]
    assert TURNED.measure(shown)[1:].max() < 1.0
    assert MOVED.measure(shown)[1:].max() < 0.06


def test_steps_ahead_are_measured_in_metres():
    ahead = look((0.0, 1.3, 0.2), 30.0, 0.0)
    poses = np.stack([ahead] * 3)
    poses[1:, :3, 3] += np.outer([0.25, 0.5], ahead[:3, 2])
    truth = seen(poses)
    assert MOVED.measure(prediction(truth.rgb, truth.depth, truth))[1:].max() < 0.06
    frozen = prediction(truth.rgb[:1].expand(3, -1, -1, -1), truth.depth[:1].expand(3, -1, -1), truth)
    assert MOVED.measure(frozen)[1:].tolist() == pytest.approx([0.25, 0.25], abs=1e-3)


def test_frames_that_turn_less_than_was_asked_are_off_by_the_difference():
    asked, shown = seen(turns(0.0, 15.0, 30.0)), seen(turns(0.0, 5.0, 20.0))
    errors = TURNED.measure(prediction(shown.rgb, shown.depth, asked))[1:]
    assert errors.tolist() == pytest.approx([10.0, 0.0], abs=1.0)


def test_the_motion_shown_depends_on_no_pose():
    truth = seen(turns(0.0, 15.0, 10.0))
    elsewhere = replace(truth, cameras=truth.cameras.at(torch.eye(4).double().repeat(3, 1, 1)))
    assert torch.equal(camera_motions(truth), camera_motions(elsewhere))


def test_a_motion_in_all_directions_is_found():
    poses = torch.from_numpy(turns(0.0, 0.0))
    motion = small_motions(torch.tensor([[0.1, -0.05, 0.15]]).double(), torch.tensor([[0.05, -0.1, 0.08]]).double())
    truth = seen(torch.cat([poses[:1], poses[1:] @ motion]).numpy())
    torch.testing.assert_close(camera_motions(truth), motion, atol=0.03, rtol=0)


def test_frames_without_depth_have_no_figure():
    truth = seen(turns(0.0, 180.0))
    missing = prediction(truth.rgb, torch.zeros_like(truth.depth), truth)
    for metric in (TURNED, MOVED):
        assert metric.measure(missing).isnan().all()


def test_frames_that_have_nothing_in_common_get_a_wrong_motion_as_the_definition_says():
    truth = seen(turns(0.0, 180.0))
    assert TURNED.measure(prediction(truth.rgb, truth.depth, truth))[1] > 90.0
    for metric in (TURNED, MOVED):
        assert "nothing in common get a wrong motion" in metric.definition


def test_a_single_frame_has_no_figure():
    truth = seen(turns(0.0))
    assert TURNED.measure(prediction(truth.rgb, truth.depth, truth)).isnan().tolist() == [True]


def test_wide_and_large_images_are_measured_as_small_ones():
    truth = observe_room(turns(0.0, 12.0), Room(96, 160))
    assert TURNED.measure(prediction(truth.rgb, truth.depth, truth))[1] < 1.0


def test_it_needs_generated_depth():
    for metric in (TURNED, MOVED):
        assert metric.obstacle(setup(generated_depth=False)) == "the model gives no depth"
        assert metric.obstacle(setup(depth=False)) is None
