from dataclasses import replace

import pytest
import torch

from persist_cli.api.memory import FORMAT_VERSION
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import CheckpointError
from tests.support.room_views import MEMORIES, empty, observe, same_bits, walked, written
from tests.support.rooms import look


@pytest.mark.parametrize("name", MEMORIES)
def test_an_empty_memory_gives_no_token_and_has_no_bounds(name):
    memory = empty(name)
    tokens = memory.read(walked(2).cameras, 100)
    assert tokens.features.shape == (0, 32)
    assert memory.figures().cells == memory.figures().bytes == 0
    assert memory.figures().bounds is None


@pytest.mark.parametrize("name", MEMORIES)
def test_a_frame_without_valid_depth_writes_nothing(name):
    observations = walked(1)
    memory = written(name, replace(observations, depth=torch.zeros_like(observations.depth)))
    assert memory.tensors() == {}


@pytest.mark.parametrize("name", MEMORIES)
def test_no_frame_writes_nothing(name):
    assert written(name, walked(1)[0:0]).tensors() == {}


@pytest.mark.parametrize("name", MEMORIES)
def test_a_budget_is_kept_and_none_gives_none(name):
    observations = walked(3)
    memory = written(name, observations)
    assert len(memory.read(observations.cameras, 7)) == (0 if name == "none" else 7)
    assert len(memory.read(observations.cameras, 0)) == 0


@pytest.mark.parametrize("name", MEMORIES)
def test_a_memory_is_restored_bit_for_bit_and_goes_on_as_if_never_stored(name):
    observations = walked()
    memory, restored = written(name, observations[:4]), empty(name)
    restored.restore(memory.tensors())
    assert same_bits(memory, restored)
    memory.write(observations[4:])
    restored.write(observations[4:])
    assert same_bits(memory, restored)


@pytest.mark.parametrize("name", MEMORIES)
def test_a_cleared_memory_is_an_empty_one(name):
    memory = written(name, walked(2))
    memory.clear()
    assert memory.tensors() == {}
    assert len(memory.points().positions) == 0


@pytest.mark.parametrize("name", MEMORIES)
def test_the_header_says_what_made_the_memory(name):
    memory = written(name, walked(2))
    header = memory.header()
    assert (header["memory"], header["encoder"], header["version"]) == (name, "patches", FORMAT_VERSION)
    assert header["cells"] == memory.figures().cells


@pytest.mark.parametrize("name", MEMORIES)
def test_memories_of_two_scenes_cannot_be_merged(name):
    memory, other = empty(name), empty(name)
    other.reference = replace(other.reference, name="cellar")
    with pytest.raises(CheckpointError, match="frame of reference"):
        memory.merge(other)


@pytest.mark.parametrize("name", MEMORIES)
def test_merging_equals_writing_both(name):
    observations = walked(6)
    memory = written(name, observations[:2])
    memory.merge(written(name, observations[2:]))
    assert same_bits(memory, written(name, observations))


@pytest.mark.parametrize("name", ["voxel", "map2d", "snapshots"])
@pytest.mark.parametrize("damage", ["missing", "unknown", "dtype", "shape", "nan"])
def test_tensors_that_are_not_the_memorys_own_are_refused_and_change_nothing(name, damage):
    memory = written(name, walked(2))
    before, tensors = written(name, walked(2)), memory.tensors()
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


def test_none_never_gives_a_token_whatever_was_written():
    memory = written("none", walked(2))
    assert len(memory.read(walked(2).cameras, 100)) == 0
    with pytest.raises(CheckpointError):
        memory.restore({"features": torch.zeros(1, 32)})


def test_a_batch_may_hold_a_sample_without_a_token_and_pads_behind_the_mask():
    observations = walked(2)
    full = written("voxel", observations).read(observations.cameras, 9)
    batch = MemoryTokens.stack([empty("voxel").read(observations.cameras, 9), full])
    assert batch.mask.sum(1).tolist() == [0, 9]
    assert batch.features[0].abs().sum() == 0
    assert torch.equal(batch.features[1], full.features)


@pytest.mark.parametrize("name", MEMORIES)
def test_frames_of_several_sizes_go_into_one_memory(name):
    memory = written(name, walked(2))
    wide = observe([look((0.0, 1.4, 0.0), 45.0)], 40, 90)
    memory.write(wide)
    assert len(memory.read(wide.cameras, 20)) == (0 if name == "none" else 20)
