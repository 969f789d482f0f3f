"""tests.memory.test_batched_reads."""

from __future__ import annotations

import pytest
import torch

from persist_memory.grid.visibility import Views
from tests.support.room_views import MEMORIES, empty, observe, same_bits, walked, written
from tests.support.rooms import look


def branches(start=30.0):
    """Cameras of four ways from one place: two turn alike at first, one stays, one is shorter."""
    ways = ([0, 8, 16, 24], [0, 8, 16, 0], [0, 0, 0, 0], [0, -20])
    return [observe([look((0.0, 1.4, 0.0), start + turn, 0.0) for turn in way]).cameras for way in ways]


def same(one, other):
    return all(torch.equal(getattr(one, name), getattr(other, name)) for name in ("features", "positions", "mask"))


@pytest.mark.parametrize("budget", [0, 7, 300])
@pytest.mark.parametrize("name", MEMORIES)
def test_each_of_several_askers_gets_what_it_would_get_alone(name, budget):
    memory, cameras = written(name, walked(8)), branches()
    together = memory.read_batch(cameras, budget)
    assert all(same(tokens, memory.read(each, budget)) for tokens, each in zip(together, cameras, strict=True))
    assert max(len(tokens) for tokens in together) <= budget


@pytest.mark.parametrize("name", MEMORIES)
def test_askers_of_an_empty_memory_get_nothing_each(name):
    assert [len(tokens) for tokens in empty(name).read_batch(branches(), 9)] == [0, 0, 0, 0]


@pytest.mark.parametrize("name", MEMORIES)
def test_askers_with_images_of_two_sizes_get_what_they_would_get_alone(name):
    memory, cameras = written(name, walked(8)), branches()
    cameras[1] = cameras[1].resized(24, 32)
    together = memory.read_batch(cameras, 50)
    assert all(same(tokens, memory.read(each, 50)) for tokens, each in zip(together, cameras, strict=True))


def test_a_camera_that_several_have_is_looked_through_once(monkeypatch):
    looked, look_through = [], Views.look
    monkeypatch.setattr(
        Views, "look", lambda self, *boxes: looked.append(len(self.apexes)) or look_through(self, *boxes)
    )
    written("voxel", walked(8)).read_batch(branches(), 100)
    assert looked == [5, 5]  # blocks, then cells; 14 cameras, of which five differ


def test_many_cells_are_found_for_askers_who_see_many_and_few():
    memory = written("voxel", walked(8), cell=(0.05, 0.05, 0.05))
    cameras = [*branches(), observe([look((0.0, 1.4, 0.0), 0.0, -89.0)]).cameras]
    together = memory.read_batch(cameras, 3000)
    assert all(same(tokens, memory.read(each, 3000)) for tokens, each in zip(together, cameras, strict=True))
    assert len({len(tokens) for tokens in together}) > 1


@pytest.mark.parametrize("name", MEMORIES)
def test_what_is_written_into_a_copy_leaves_the_memory_as_it_was_and_the_other_way_round(name):
    observations = walked(9)
    first, second = observations[:3], observations[:6]
    memory = written(name, first)
    copies = [memory.copy(), memory.copy()]
    copies[0].write(observations[3:6])
    assert same_bits(memory, written(name, first))
    memory.write(observations[6:])
    assert same_bits(copies[0], written(name, second))
    assert same_bits(copies[1], written(name, first))
    copies[1].write(observations[6:])
    assert same_bits(copies[1], memory)


@pytest.mark.parametrize("name", MEMORIES)
def test_a_copy_of_a_cleared_memory_and_a_cleared_copy_hold_nothing_else(name):
    memory = written(name, walked(3))
    copy = memory.copy()
    copy.clear()
    assert same_bits(memory, written(name, walked(3)))
    assert same_bits(copy.copy(), empty(name))


def test_a_copy_takes_no_room_until_it_is_written():
    memory = written("voxel", walked(3))
    copy = memory.copy()
    assert copy.grid._buffers["features"].data_ptr() == memory.grid._buffers["features"].data_ptr()
    copy.write(walked(1))
    assert copy.grid._buffers["features"].data_ptr() != memory.grid._buffers["features"].data_ptr()


def test_nobody_asks_for_nothing():
    assert written("voxel", walked(2)).read_batch([], 5) == []
