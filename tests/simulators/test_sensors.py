"""Light and colours change a whole scene alike; a Kinect's depth is noisy, in steps, and has holes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from persist_cli.api.cells import CellForm, CellGrid
from persist_cli.simulators.collect import CollectPlan, recorded, scene_look
from persist_cli.simulators.sensors import NOISE, QUANTUM, SPECKLE, Look, in_shadow, kinect_depth, sensed
from tests.support.noise import INFO, make_frames

INTRINSICS = np.array([[58.0, 0.0, 32.0], [0.0, 58.0, 32.0], [0.0, 0.0, 1.0]])


def measured(metres: float) -> np.ndarray:
    wall = np.full((64, 64), metres, np.float32)
    return kinect_depth(wall, INTRINSICS, np.random.default_rng(0))


def test_the_error_of_the_depth_grows_with_its_square() -> None:
    near, far = (np.abs(depth[depth > 0] - metres).mean() for metres in (1.0, 4.0) for depth in [measured(metres)])
    assert 12 < far / near < 20


def test_a_far_wall_is_measured_in_few_steps() -> None:
    depth = measured(4.0)
    values = np.unique(depth[depth > 0])
    assert 3 < len(values) < 12
    assert np.diff(values).min() > 0.03


def test_there_is_no_depth_too_near_or_too_far() -> None:
    assert not measured(0.4).any()
    assert not measured(8.5).any()
    assert (measured(2.0) > 0).mean() > 0.98


def test_the_noise_of_the_depth_is_that_of_the_sensor_and_some_pixels_have_none() -> None:
    wall = np.full((200, 200), 2.0, np.float32)
    depth = kinect_depth(wall, INTRINSICS, np.random.default_rng(0))
    assert depth[depth > 0].std() == pytest.approx(4 * math.hypot(NOISE, QUANTUM / math.sqrt(12)), rel=0.05)
    assert (depth == 0).mean() == pytest.approx(SPECKLE, rel=0.3)


def test_a_near_thing_throws_a_shadow_to_the_side_that_the_projector_does_not_light() -> None:
    depth = np.full((4, 64), 3.0, np.float32)
    depth[:, 30:40] = 1.0
    shadow = in_shadow(depth, focal=58.0)
    assert shadow[:, 26:30].any(axis=1).all()
    assert not shadow[:, 30:].any()
    assert not shadow[:, :25].any()
    depth[:, 30:40] = 2.4  # a quarter nearer than the wall
    assert in_shadow(depth, focal=580.0)[:, 24:30].any()
    depth[:, 30:40] = 2.9  # hardly nearer, as a wall that is seen from aside
    assert not in_shadow(depth, focal=580.0).any()


def test_light_and_tint_change_every_frame_of_a_scene_alike() -> None:
    look = Look.draw(0.5, 0.2, np.random.default_rng(1))
    grey = np.full((2, 2, 3), 100, np.uint8)
    assert look.apply(grey).mean() == look.apply(grey[:1]).mean()
    assert 35 < look.apply(grey).mean() < 65
    assert len(set(look.apply(grey)[0, 0].tolist())) > 1


def test_without_light_and_tint_no_pixel_changes() -> None:
    image = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    assert np.array_equal(Look.draw(1.0, 0.0, np.random.default_rng(1)).apply(image), image)


def test_the_cells_of_a_scene_have_the_colours_of_its_frames() -> None:
    grid = CellGrid.empty(CellForm(), (0.0, 1.0, 0.0)).box((0, 0, 0), (2, 1, 1))
    grid.colors[:] = 100
    frame = replace(make_frames(1)[0], cells=grid)
    dark = sensed(frame, Look(0.5, (1.0, 0.9, 1.1)), "exact", INTRINSICS, np.random.default_rng(0))
    assert dark.cells is not None
    assert dark.cells.colors.reshape(-1, 3).tolist() == [[50, 45, 55]] * 2
    assert torch.equal(grid.colors, torch.full_like(grid.colors, 100))


KINECT = CollectPlan(simulator="miniworld", scenes="0:2", depth_sensor="kinect", light="0.5:1.5", tint="0.2")


def test_each_frame_of_a_walk_has_depth_errors_of_its_own_and_always_the_same() -> None:
    frame = replace(make_frames(1)[0], depth=np.full((16, 24), 2.0, np.float32))
    first, second = (one.depth for one in recorded(iter([frame, frame]), KINECT, 5, INFO))
    again = next(recorded(iter([frame]), KINECT, 5, INFO)).depth
    elsewhere = next(recorded(iter([frame]), KINECT, 6, INFO)).depth
    assert np.array_equal(first, again)
    assert (first != second).mean() > 0.1
    assert (first != elsewhere).mean() > 0.1


def test_each_scene_and_seed_draws_light_and_colours_of_its_own() -> None:
    looks = [scene_look(replace(KINECT, seed=seed), scene) for seed in (0, 1) for scene in (0, 1)]
    assert len({*looks}) == 4
    assert scene_look(KINECT, 0) == looks[0]
    assert all(0.5 <= look.light <= 1.5 and max(abs(gain - 1) for gain in look.gains) <= 0.2 for look in looks)
    assert {gain > 1 for look in looks for gain in look.gains} == {True, False}
