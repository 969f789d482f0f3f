import math
from dataclasses import replace

import pytest
import torch

from persist_cli.api.memory import FrameOfReference
from persist_cli.api.memory_file import FORMAT_VERSION
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import CheckpointError, DataError, PersistError
from persist_cli.plugins import make_encoder, make_memory
from tests.support.room_views import MEMORIES, empty_memory, observe, room_walk, same_bits, written_memory
from tests.support.rooms import UP, look


@pytest.mark.parametrize("name", MEMORIES)
def test_an_empty_memory_gives_no_token_and_has_no_bounds(name):
    memory = empty_memory(name)
    tokens = memory.read(room_walk(2).cameras, 100)
    assert tokens.features.shape == (0, 32)
    assert memory.figures().cells == memory.figures().bytes == 0
    assert memory.figures().bounds is None


@pytest.mark.parametrize("name", MEMORIES)
def test_a_frame_without_valid_depth_writes_nothing(name):
    observations = room_walk(1)
    memory = written_memory(name, replace(observations, depth=torch.zeros_like(observations.depth)))
    assert memory.tensors() == {}


@pytest.mark.parametrize("name", [*MEMORIES, "points", "scene"])
@pytest.mark.parametrize("sky", [math.inf, -math.inf, math.nan])
def test_depth_that_is_not_finite_is_missing(name, sky):
    observations = room_walk(1)
    with_sky, without = observations.depth.clone(), observations.depth.clone()
    with_sky[:, :16], without[:, :16] = sky, 0.0
    encoder = make_encoder("classes" if name == "scene" else "patches", {})
    memory, other = (make_memory(name, {}, encoder, FrameOfReference("room", UP)) for _ in range(2))
    memory.write(replace(observations, depth=with_sky))
    other.write(replace(observations, depth=without))
    stored, wanted = memory.tensors(), other.tensors()
    assert stored.keys() == wanted.keys()
    assert all(torch.equal(stored[part], wanted[part]) for part in stored if part != "content")  # a hash of the frame


@pytest.mark.parametrize("name", MEMORIES)
def test_writing_no_frames_writes_nothing(name):
    assert written_memory(name, room_walk(1)[0:0]).tensors() == {}


@pytest.mark.parametrize("name", MEMORIES)
def test_a_read_gives_at_most_the_budget_and_no_token_for_a_budget_of_zero(name):
    observations = room_walk(3)
    memory = written_memory(name, observations)
    assert len(memory.read(observations.cameras, 7)) == (0 if name == "none" else 7)
    assert len(memory.read(observations.cameras, 0)) == 0


@pytest.mark.parametrize("name", ["voxel", "map2d", "snapshots"])
def test_tokens_tell_from_how_near_their_surfaces_were_seen(name):
    far, near = observe([look((0.0, 1.4, 1.0), 0.0)]), observe([look((0.0, 1.4, 0.5), 0.0)])
    memory = written_memory(name, far)
    seen = memory.read(far.cameras, 1000).distances
    assert far.depth.min() - 0.01 < seen.min() < seen.max() < far.depth.max() + 0.01
    memory.write(near)
    assert memory.read(far.cameras, 1000).distances.max() < seen.max() + 0.01
    assert near.depth.min() - 0.01 < memory.read(near.cameras, 1000).distances.min() < seen.min() - 0.3


@pytest.mark.parametrize("name", MEMORIES)
def test_a_restored_memory_is_equal_to_the_bit_and_so_is_what_is_written_afterwards(name):
    observations = room_walk()
    memory, restored = written_memory(name, observations[:4]), empty_memory(name)
    restored.restore(memory.tensors())
    assert same_bits(memory, restored)
    memory.write(observations[4:])
    restored.write(observations[4:])
    assert same_bits(memory, restored)


@pytest.mark.parametrize("name", MEMORIES)
def test_a_cleared_memory_is_empty(name):
    memory = written_memory(name, room_walk(2))
    memory.clear()
    assert memory.tensors() == {}
    assert len(memory.points().positions) == 0


@pytest.mark.parametrize("name", MEMORIES)
def test_the_header_says_what_made_the_memory(name):
    memory = written_memory(name, room_walk(2))
    header = memory.header()
    assert (header["memory"], header["encoder"], header["version"]) == (name, "patches", FORMAT_VERSION)
    assert header["cells"] == memory.figures().cells


@pytest.mark.parametrize("name", MEMORIES)
def test_memories_of_two_scenes_cannot_be_merged(name):
    memory, other = empty_memory(name), empty_memory(name)
    other.reference = replace(other.reference, name="cellar")
    with pytest.raises(CheckpointError, match="frame of reference"):
        memory.merge(other)


@pytest.mark.parametrize("name", MEMORIES)
def test_merging_two_memories_equals_writing_both_into_one(name):
    observations = room_walk(6)
    memory = written_memory(name, observations[:2])
    memory.merge(written_memory(name, observations[2:]))
    assert same_bits(memory, written_memory(name, observations))


@pytest.mark.parametrize("name", ["voxel", "map2d", "snapshots"])
@pytest.mark.parametrize("damage", ["missing", "unknown", "dtype", "shape", "nan"])
def test_restoring_tensors_that_do_not_fit_is_refused_and_changes_nothing(name, damage):
    memory = written_memory(name, room_walk(2))
    before, tensors = written_memory(name, room_walk(2)), memory.tensors()
    match damage:
        case "missing":
            del tensors["features"]
        case "unknown":
            tensors["surprise"] = torch.zeros(3)
        case "dtype":
            tensors["colors"] = tensors["colors"].float()
        case "shape":
            tensors["features"] = tensors["features"][..., :-1]
        case "nan":
            tensors["features"] = tensors["features"] * torch.nan
    with pytest.raises(CheckpointError, match=f"memory '{name}'"):
        memory.restore(tensors)
    assert same_bits(memory, before)


def test_the_memory_none_never_gives_a_token():
    memory = written_memory("none", room_walk(2))
    assert len(memory.read(room_walk(2).cameras, 100)) == 0
    with pytest.raises(CheckpointError):
        memory.restore({"features": torch.zeros(1, 32)})


def test_a_sample_without_a_token_is_padding_in_a_batch_of_tokens():
    observations = room_walk(2)
    full = written_memory("voxel", observations).read(observations.cameras, 9)
    batch = MemoryTokens.stack([empty_memory("voxel").read(observations.cameras, 9), full])
    assert batch.mask.sum(1).tolist() == [0, 9]
    assert batch.features[0].abs().sum() == 0
    assert torch.equal(batch.features[1], full.features)


@pytest.mark.parametrize("name", MEMORIES)
def test_one_memory_takes_frames_of_several_sizes(name):
    memory = written_memory(name, room_walk(2))
    wide = observe([look((0.0, 1.4, 0.0), 45.0)], 40, 90)
    memory.write(wide)
    assert len(memory.read(wide.cameras, 20)) == (0 if name == "none" else 20)


@pytest.mark.parametrize("name", ["voxel", "map2d", "snapshots", "points", "scene"])
@pytest.mark.parametrize(
    ("spoil", "cause"),
    [
        (lambda frames: replace(frames, rgb=frames.rgb / 255), "rgb is torch.float32"),
        (lambda frames: replace(frames, rgb=frames.rgb[..., :1]), r"rgb is torch.uint8 \[1, .*, 1\]"),
        (lambda frames: replace(frames, depth=(frames.depth * 1000).short()), "depth is torch.int16"),
    ],
)
def test_frames_of_another_type_are_refused_and_nothing_is_written(name, spoil, cause):
    encoder = make_encoder("classes" if name == "scene" else "patches", {})
    memory = make_memory(name, {}, encoder, FrameOfReference("room", UP))
    with pytest.raises(DataError, match=cause):
        memory.write(spoil(room_walk(1)))
    assert memory.tensors() == {}


@pytest.mark.parametrize(
    ("name", "settings"),
    [("voxel", {"cell": [math.inf, 1, 1]}), ("map2d", {"cell": [1, math.inf]}), ("points", {"spread": math.inf})],
)
def test_a_memory_takes_no_infinite_lengths(name, settings):
    with pytest.raises(PersistError, match="above 0, not"):
        make_memory(name, settings, make_encoder("patches", {}), FrameOfReference("room", UP))
