"""Drift of generated surfaces in a furnished room."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from persist_cli.api.cameras import Cameras
from persist_cli.metrics import METRICS
from persist_cli.metrics.drift import VOXEL
from tests.support.predictions import observe_room, prediction
from tests.support.rooms import Room, look, walk

DRIFT = METRICS["drift"]


def drift_of_a_wall(shift: float) -> torch.Tensor:
    """Drift of a wall 2.5 m away that is generated farther away by ``shift``."""
    truth = observe_room(np.stack([look((0.0, 1.3, 0.0), 90.0, 0.0)] * 2), Room(48, 48, field_of_view=30.0))
    assert float(truth.depth.std()) < 1e-6
    return DRIFT.measure(prediction(truth.rgb, truth.depth + shift, truth))


def test_the_truth_itself_drifts_less_than_a_voxel():
    truth = observe_room(walk(12))
    assert DRIFT.measure(prediction(truth.rgb, truth.depth, truth)).max() < VOXEL


@pytest.mark.parametrize("shift", [0.2, 0.5, -0.5])
def test_a_wall_that_moves_away_drifts_by_as_much(shift):
    assert drift_of_a_wall(shift).tolist() == pytest.approx([abs(shift)] * 2, rel=0.03)


def test_where_no_true_depth_is_sampled_there_is_no_drift():
    truth = observe_room(walk(2), Room(512, 512))  # of which 256 rows are fused and 64 others measured
    sparse = torch.zeros_like(truth.depth)
    sparse[:, 4::8, 4::8] = 1.0
    assert DRIFT.measure(prediction(truth.rgb, truth.depth, replace(truth, depth=sparse))).isnan().all()


def test_one_wrong_frame_does_not_change_the_figures_of_others():
    truth = observe_room(walk(6))
    wrong = truth.depth.clone()
    wrong[3] *= 1.5
    before, after = (DRIFT.measure(prediction(truth.rgb, depth, truth)) for depth in (truth.depth, wrong))
    assert torch.equal(before[[0, 1, 2, 4, 5]], after[[0, 1, 2, 4, 5]])
    assert after[3] > 0.3 > VOXEL > before[3]


def test_a_moved_world_changes_no_drift():
    truth = observe_room(walk(6))
    motion = torch.from_numpy(look((40.0, -7.0, 3.0), 77.0, -20.0))
    cameras = truth.cameras
    moved = replace(
        truth, cameras=Cameras(motion @ cameras.world_from_camera, cameras.intrinsics, cameras.height, cameras.width)
    )
    depth = truth.depth * 1.1
    here, there = (DRIFT.measure(prediction(truth.rgb, depth, frames)) for frames in (truth, moved))
    torch.testing.assert_close(here, there, atol=1e-6, rtol=0)


def test_the_drift_of_a_shift_is_alike_for_small_and_large_images():
    for size in (48, 480):
        truth = observe_room(walk(2), Room(size, size))
        figures = DRIFT.measure(prediction(truth.rgb, truth.depth + 0.4, truth))
        assert figures.tolist() == pytest.approx([0.33, 0.33], abs=0.09)
