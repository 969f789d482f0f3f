"""The benchmark of frames of a walk runs, also with a large map."""

from __future__ import annotations

import random

from tests.benchmarks.bench_play import costs_of_walk, enlarge, walk
from tests.support.micro_plays import micro_walks
from tests.support.room_views import observe, written_memory
from tests.support.rooms import look


def test_a_walk_is_measured_in_parts(walks):
    play = micro_walks(walks)()
    first, every = walk(play, 6, random.Random(0))
    assert len(every) >= 6
    assert 0 < len(first) <= len(every)
    costs = costs_of_walk(play, 12, 6, seed=0)
    assert len(costs) == 2
    assert costs[-1].frames >= 12
    assert all(0 < cost.first <= cost.first_95 for cost in costs)


def test_a_map_is_enlarged_by_copies_beside_each_other():
    memory = written_memory("voxel", observe([look((0.0, 1.4, 0.0), 20.0)]))
    before = memory.figures().cells
    enlarge(memory, 5 * before)
    assert memory.figures().cells == 5 * before
