import copy

import numpy as np
import pytest
import torch

from persist_cli.metrics.poses import ate, rpe
from persist_cli.world.errors import DataError
from tests.rooms import look, walk


def wandering(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """An estimate of a path whose error grows, and the path."""
    draw, true = np.random.default_rng(seed), walk(24)
    poses = true.copy()
    for number, pose in enumerate(poses):
        turn = look((0.0, 0.0, 0.0), 2 * draw.normal(), draw.normal())
        pose[:3, :3] = turn[:3, :3] @ pose[:3, :3]
        pose[:3, 3] += 0.02 * number * draw.normal(size=3)
    return torch.from_numpy(poses), torch.from_numpy(true)


def test_the_true_path_has_no_error():
    path = torch.from_numpy(walk(12))
    assert ate(path, path) == 0
    assert rpe(path, path) == pytest.approx(0, abs=1e-15)


def test_a_shifted_world_is_an_absolute_but_no_relative_error():
    path = torch.from_numpy(walk(12))
    shifted = path.clone()
    shifted[:, :3, 3] += torch.tensor([0.3, 0.0, 0.4])
    assert ate(shifted, path) == pytest.approx(0.5)
    assert rpe(shifted, path) == pytest.approx(0, abs=1e-12)


def test_neither_scale_nor_rotation_is_aligned_away():
    path = torch.from_numpy(walk(12))
    scaled = path.clone()
    scaled[:, :3, 3] *= 2
    assert ate(scaled, path) == pytest.approx(float(path[:, :3, 3].norm(dim=-1).square().mean().sqrt()))
    turned = torch.from_numpy(look((0.0, 0.0, 0.0), 90.0, 0.0)) @ path
    assert ate(turned, path) > 1


def test_ate_and_rpe_equal_evo():
    trajectory = pytest.importorskip("evo.core.trajectory")
    metrics = pytest.importorskip("evo.core.metrics")
    poses, true = wandering(0)
    pair = tuple(trajectory.PosePath3D(poses_se3=list(copy.deepcopy(each.numpy()))) for each in (true, poses))
    relation = metrics.PoseRelation.translation_part
    for ours, theirs in ((ate, metrics.APE(relation)), (rpe, metrics.RPE(relation, 1, metrics.Unit.frames))):
        theirs.process_data(pair)
        assert ours(poses, true) == pytest.approx(theirs.get_statistic(metrics.StatisticsType.rmse), rel=1e-9)


def test_paths_that_cannot_be_compared_are_one_line():
    path = torch.from_numpy(walk(12))
    broken = path.clone()
    broken[3, 0, 0] = float("nan")
    for call, cause in (
        (lambda: ate(path[:5], path), r"poses \[5, 4, 4\] against true ones \[12, 4, 4\]"),
        (lambda: rpe(path[:1], path[:1]), "at least 2"),
        (lambda: ate(path[:0], path[:0]), "at least 1"),
        (lambda: ate(broken, path), "estimated poses: the pose of frame 3 is not finite"),
        (lambda: rpe(path, broken), "true poses: the pose of frame 3 is not finite"),
    ):
        with pytest.raises(DataError, match=cause):
            call()
