"""Reading a memory for several camera paths at once, as the branches of a rollout do, and copies of memories."""

from __future__ import annotations

import pytest
import torch
from torch.profiler import ProfilerActivity, profile

from persist_memory.batched_reads import distinct_cameras
from tests.support.room_views import MEMORIES, empty_memory, observe, room_walk, same_bits, written_memory
from tests.support.rooms import look


def branches():
    """Camera paths from one place: two that turn alike at first, one that stays, and a shorter one."""
    turns = ([0, 8, 16, 24], [0, 8, 16, 0], [0, 0, 0, 0], [0, -20])
    return [observe([look((0.0, 1.4, 0.0), 30.0 + turn, 0.0) for turn in path]).cameras for path in turns]


def equal_tokens(one, other):
    return all(torch.equal(getattr(one, name), getattr(other, name)) for name in ("features", "positions", "mask"))


def allocated_bytes(work):
    """Bytes that torch allocates on the CPU during a piece of work, whether freed again or not."""
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiler:
        work()
    return sum(max(event.self_cpu_memory_usage, 0) for event in profiler.events())


def each_path_gets_what_it_gets_alone(memory, paths, budget):
    batch = memory.read_batch(paths, budget)
    alone = [memory.read(path, budget) for path in paths]
    return all(equal_tokens(*pair) for pair in zip(batch, alone, strict=True))


@pytest.mark.parametrize("budget", [0, 7, 300])
@pytest.mark.parametrize("name", MEMORIES)
def test_a_batched_read_gives_every_path_what_it_gets_alone(name, budget):
    memory = written_memory(name, room_walk(8))
    assert each_path_gets_what_it_gets_alone(memory, branches(), budget)
    assert max(len(tokens) for tokens in memory.read_batch(branches(), budget)) <= budget


@pytest.mark.parametrize("name", MEMORIES)
def test_a_batched_read_of_an_empty_memory_gives_every_path_no_token(name):
    assert [len(tokens) for tokens in empty_memory(name).read_batch(branches(), 9)] == [0, 0, 0, 0]


@pytest.mark.parametrize("name", MEMORIES)
def test_a_batched_read_takes_paths_of_different_image_sizes(name):
    paths = branches()
    paths[1] = paths[1].resized(24, 32)
    assert each_path_gets_what_it_gets_alone(written_memory(name, room_walk(8)), paths, 50)


def test_a_read_for_all_paths_together_holds_what_each_of_them_gets():
    memory = written_memory("voxel", room_walk(8))
    together = {*map(tuple, memory.read_together(branches(), 100_000).positions.tolist())}
    alone = [{*map(tuple, memory.read(path, 100_000).positions.tolist())} for path in branches()]
    assert set.union(*alone) <= together
    assert max(map(len, alone)) < len(together) < len(memory.grid)


def test_paths_are_not_read_together_where_a_budget_would_leave_tokens_out():
    memory = written_memory("voxel", room_walk(8))
    count = len(memory.read_together(branches(), 100_000))
    assert memory.read_together(branches(), count - 1) is None
    assert len(memory.read_together(branches(), count)) == count


@pytest.mark.parametrize("name", ["map2d", "snapshots"])
def test_paths_are_not_read_together_where_tokens_depend_on_the_path(name):
    assert written_memory(name, room_walk(8)).read_together(branches(), 100_000) is None


def test_paths_of_different_image_sizes_are_not_read_together():
    paths = branches()
    paths[1] = paths[1].resized(24, 32)
    assert written_memory("voxel", room_walk(8)).read_together(paths, 100_000) is None


def test_distinct_cameras_holds_every_camera_once_and_gives_every_path_its_own():
    paths = branches()
    cameras, positions = distinct_cameras(paths)
    assert len(cameras) == 5  # of 14
    for path, path_positions in zip(paths, positions, strict=True):
        assert torch.equal(cameras[path_positions].world_from_camera, path.world_from_camera)


def test_a_batched_read_computes_the_view_of_every_distinct_camera_once(monkeypatch):
    memory, calls = written_memory("voxel", room_walk(8)), []
    views = memory.views
    monkeypatch.setattr(memory, "views", lambda cameras: calls.append(len(cameras)) or views(cameras))
    memory.read_batch(branches(), 100)
    assert calls == [5]


def test_a_batched_read_finds_many_cells_for_one_path_and_few_for_another():
    memory = written_memory("voxel", room_walk(8), cell=(0.05, 0.05, 0.05))
    paths = [*branches(), observe([look((0.0, 1.4, 0.0), 0.0, -89.0)]).cameras]
    assert each_path_gets_what_it_gets_alone(memory, paths, 3000)
    assert len({len(tokens) for tokens in memory.read_batch(paths, 3000)}) > 1


def test_a_batched_read_of_no_path_gives_nothing():
    assert written_memory("voxel", room_walk(2)).read_batch([], 5) == []


@pytest.mark.parametrize("name", MEMORIES)
def test_writing_into_a_copy_does_not_change_the_memory_nor_the_other_way_round(name):
    observations = room_walk(9)
    first, second = observations[:3], observations[:6]
    memory = written_memory(name, first)
    copies = [memory.copy(), memory.copy()]
    copies[0].write(observations[3:6])
    assert same_bits(memory, written_memory(name, first))
    memory.write(observations[6:])
    assert same_bits(copies[0], written_memory(name, second))
    assert same_bits(copies[1], written_memory(name, first))
    copies[1].write(observations[6:])
    assert same_bits(copies[1], memory)


@pytest.mark.parametrize("name", MEMORIES)
def test_clearing_a_copy_leaves_the_memory_as_it_was_and_its_own_copies_empty(name):
    memory = written_memory(name, room_walk(3))
    copy = memory.copy()
    copy.clear()
    assert same_bits(memory, written_memory(name, room_walk(3)))
    assert same_bits(copy.copy(), empty_memory(name))


def test_a_copy_takes_no_memory_of_its_own_until_it_is_written():
    memory = written_memory("voxel", room_walk(3), encoder={"channels": 192})
    stored = memory.figures().bytes
    assert allocated_bytes(memory.tensors) >= stored
    assert allocated_bytes(memory.copy) < stored / 10
