"""What frames see through is removed, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from persist_memory.carving import nearest_within, seen_through
from tests.memory.views_of_room import empty, observe, walked, written
from tests.rooms import look

CARVE = {"cell": (0.125, 0.125, 0.125), "carve": 0.25}
AHEAD = observe(np.stack([look((0.0, 1.3, 0.2), 0.0, 0.0)]))


def cells(memory):
    return {tuple(cell.tolist()) for cell in memory.tensors()["cells"]}


def test_a_wall_that_is_not_there_any_more_is_forgotten_where_it_is_seen_through():
    screen = replace(AHEAD, depth=AHEAD.depth.clamp(max=1.2))
    memory = written("voxel", screen, **CARVE)
    before = len(cells(memory))
    memory.write(AHEAD)
    left = cells(memory) - cells(written("voxel", AHEAD, **CARVE))
    assert len(left) < 0.5 * before  # of cells at the image's rim nobody knows


def test_without_carving_everything_stays():
    screen = replace(AHEAD, depth=AHEAD.depth.clamp(max=1.2))
    memory = written("voxel", screen, cell=CARVE["cell"])
    before = cells(memory)
    memory.write(AHEAD)
    assert before <= cells(memory)


def test_a_room_that_stays_as_it_is_loses_nothing():
    observations = walked(24)
    memory, whole = empty("voxel", **CARVE), written("voxel", observations, cell=CARVE["cell"])
    for number in range(len(observations)):
        memory.write(observations[number : number + 1])
    assert len(cells(whole) - cells(memory)) < 0.005 * len(cells(whole))


def test_what_stands_before_a_cell_or_has_no_depth_removes_nothing():
    memory = written("voxel", AHEAD, **CARVE)
    before = cells(memory)
    memory.write(replace(AHEAD, depth=AHEAD.depth * 0.5))
    assert before <= cells(memory)
    memory.write(replace(AHEAD, depth=torch.zeros_like(AHEAD.depth)))
    assert before <= cells(memory)


@pytest.mark.parametrize(("behind", "gone"), [(0.1, False), (0.3, False), (0.4, True), (3.0, True)])
def test_the_surface_must_lie_the_margin_behind_the_cell(behind, gone):
    forward = AHEAD.cameras.world_from_camera[0, :3, 2]
    center = AHEAD.cameras.centers[:1] + 1.5 * forward
    flat = replace(AHEAD, depth=torch.full_like(AHEAD.depth, 1.5 + behind))
    assert bool(seen_through(center, 0.1, 0.25, flat)) == gone


def test_the_nearest_depth_around_a_pixel_is_zero_where_any_is_missing():
    depth = torch.full((1, 7, 7), 2.0)
    depth[0, 3, 5] = 1.0
    near = nearest_within(depth, 1)[0]
    assert (near[3, 3], near[3, 4], near[0, 0]) == (2.0, 1.0, 0.0)
    depth[0, 3, 5] = 0.0
    assert nearest_within(depth, 1)[0, 3, 4] == 0.0


def test_a_map_that_forgot_is_saved_and_goes_on(tmp_path):
    memory = written("voxel", replace(AHEAD, depth=AHEAD.depth.clamp(max=1.2)), **CARVE)
    memory.write(AHEAD)
    other = empty("voxel", **CARVE)
    other.restore(memory.tensors())
    for each in (memory, other):
        each.write(walked(4))
    one, two = memory.tensors(), other.tensors()
    assert all(torch.equal(one[name], two[name]) for name in one)
