"""Light and colours change a whole scene alike; a Kinect's depth is noisy, in steps, and has holes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from persist_cli.api.cells import CellForm, CellGrid
from persist_cli.simulators.sensors import Look, in_shadow, kinect_depth, sensed
from tests.support.noise import make_frames

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


def test_a_near_thing_throws_a_shadow_to_the_side_that_the_projector_does_not_light() -> None:
    depth = np.full((4, 64), 3.0, np.float32)
    depth[:, 30:40] = 1.0
    shadow = in_shadow(depth, focal=58.0)
    assert shadow[:, 26:30].any(axis=1).all()
    assert not shadow[:, 30:].any()
    assert not shadow[:, :25].any()


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
