"""Memory files are read back to the bit; files that are damaged or do not fit are errors of one line."""

from __future__ import annotations

import json
import math

import pytest
import torch
from safetensors.torch import save_file

from persist_cli.api.memory_file import read_header
from persist_cli.api.observations import Origin
from persist_cli.errors import CheckpointError, PersistError
from persist_cli.io.files import read_tensors
from persist_cli.memorize.memory_file import load_memory, load_paths
from tests.support.room_views import MEMORIES, room_walk, same_bits, written_memory


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "room.safetensors"
    written_memory("voxel", room_walk(3), cell=(0.5, 1.0, 0.5), encoder={"channels": 8}).save(path)
    return path


def with_header(path, **changes):
    """Change entries of a file's header and return the file's path."""
    tensors, metadata = read_tensors(path)
    header = json.loads(metadata["persist"]) | changes
    save_file(tensors, path, {"persist": json.dumps(header)})
    return path


@pytest.mark.parametrize("name", MEMORIES)
def test_a_memory_survives_save_and_load_bit_for_bit(tmp_path, name):
    memory = written_memory(name, room_walk())
    memory.save(tmp_path / "memory.safetensors")
    loaded = load_memory(tmp_path / "memory.safetensors")
    assert same_bits(memory, loaded)
    assert (type(loaded), loaded.settings, loaded.reference) == (type(memory), memory.settings, memory.reference)
    cameras = room_walk().cameras
    assert torch.equal(memory.read(cameras, 99).features, loaded.read(cameras, 99).features)


def test_a_memory_file_does_not_depend_on_the_order_of_writing(tmp_path):
    forward, backward = room_walk(4), room_walk(4)[[3, 2, 1, 0]]
    for name, observations in (("a", forward), ("b", backward)):
        written_memory("voxel", observations).save(tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_the_header_is_read_without_the_tensors(saved):
    header = read_header(saved)
    assert (header["memory"], header["encoder"], header["channels"], header["reference"]) == (
        "voxel", "patches", 8, "room",
    )  # fmt: skip
    assert header["settings"]["cell"] == [0.5, 1.0, 0.5]


def test_settings_are_read_back_from_a_memory_file(saved):
    assert load_memory(saved).settings.cell == (0.5, 1.0, 0.5)


@pytest.mark.parametrize("keep", [0, 4, 60, -1])
def test_a_truncated_file_is_refused_in_one_line(saved, keep):
    saved.write_bytes(saved.read_bytes()[:keep])
    with pytest.raises(CheckpointError, match="not a whole") as caught:
        load_memory(saved)
    assert str(saved) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_and_a_foreign_file_have_different_errors(tmp_path):
    with pytest.raises(CheckpointError, match="no such memory file"):
        load_memory(tmp_path / "none.safetensors")
    save_file({"weight": torch.zeros(3)}, tmp_path / "model.safetensors")
    with pytest.raises(CheckpointError, match="no memory of persist"):
        load_memory(tmp_path / "model.safetensors")


@pytest.mark.parametrize(
    ("changes", "cause"),
    [
        ({"format": "persist-checkpoint"}, "not as a memory file"),
        ({"version": 99}, "of version 99"),
        ({"world_up": [0, 0, 0]}, "header is damaged .see world_up"),
        ({"world_up": [0, math.nan, 1]}, "header is damaged .see world_up"),
        ({"world_up": [0, 10**400, 1]}, "header is damaged .see world_up"),
        ({"channels": None}, "header is damaged .see channels"),
        ({"channels": 16}, "written with 16 channels"),
        ({"cells": 3}, "the header says 3; the file is damaged, or restore"),
        ({"encoder": "gone"}, "unknown encoder 'gone'"),
        ({"memory": "map2d"}, "cell"),
        ({"settings": {"cells": 1}}, "did you mean 'cell'"),
        ({"encoder_settings": {"channels": 9}}, "written with 8 channels"),
    ],
)
def test_a_header_that_does_not_fit_is_refused_in_one_line_naming_the_file(saved, changes, cause):
    with pytest.raises(PersistError, match=cause) as caught:
        load_memory(with_header(saved, **changes))
    assert str(caught.value).startswith(str(saved))
    assert "\n" not in str(caught.value)


def test_a_header_nested_too_deeply_is_refused_in_one_line(tmp_path):
    save_file({"weight": torch.zeros(3)}, tmp_path / "m.safetensors", {"persist": "[" * 100_000})
    with pytest.raises(CheckpointError, match=r"m\.safetensors: its header is damaged"):
        load_memory(tmp_path / "m.safetensors")


@pytest.mark.parametrize("name", MEMORIES)
def test_a_memory_file_of_version_1_still_loads_with_all_of_it_observed(tmp_path, name):
    memory, path = written_memory(name, room_walk(3)), tmp_path / "old.safetensors"
    header = {key: value for key, value in memory.header().items() if key != "imagined"} | {"version": 1}
    tensors = {key: tensor for key, tensor in memory.tensors().items() if key != "origins"}
    save_file(tensors, path, {"persist": json.dumps(header)})
    assert same_bits(load_memory(path), memory)
    assert load_memory(path).figures().imagined == 0
    assert load_paths(path) == {}


def test_a_memory_file_keeps_what_is_imagined_and_the_paths(tmp_path):
    walk = room_walk(6)
    memory = written_memory("voxel", walk[:2])
    memory.write(walk[2:].with_origin(Origin.IMAGINED))
    memory.save(tmp_path / "m.safetensors", {"there": walk.cameras.world_from_camera})
    loaded = load_memory(tmp_path / "m.safetensors")
    assert same_bits(loaded, memory)
    assert read_header(tmp_path / "m.safetensors")["imagined"] == loaded.figures().imagined > 0
    assert torch.equal(load_paths(tmp_path / "m.safetensors")["there"], walk.cameras.world_from_camera)


@pytest.mark.parametrize("poses", [torch.zeros(3, 4), torch.full((2, 4, 4), torch.nan)])
def test_a_damaged_path_in_a_memory_file_is_refused_in_one_line(tmp_path, poses):
    written_memory("voxel", room_walk(1)).save(tmp_path / "m.safetensors", {"there": poses})
    with pytest.raises(CheckpointError, match=r"m\.safetensors: its path 'there', .* is no list of finite poses$"):
        load_paths(tmp_path / "m.safetensors")


@pytest.mark.parametrize("damage", ["unsorted", "twice", "beyond"])
def test_a_file_with_impossible_cells_is_refused(saved, damage):
    tensors, metadata = read_tensors(saved)
    if damage == "beyond":
        tensors["cells"][0, 0] = 1 << 22
    else:
        tensors["cells"] = tensors["cells"].flip(0) if damage == "unsorted" else tensors["cells"].roll(1, 0)
    if damage == "twice":
        tensors["cells"][0] = tensors["cells"][1]
    save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, saved, metadata)
    with pytest.raises(CheckpointError, match=r"not in order|beyond"):
        load_memory(saved)
