"""Files are written whole or not at all, and damaged ones are errors of one line."""

from __future__ import annotations

import pytest
import torch

from persist_cli.errors import CheckpointError
from persist_cli.io.files import (
    ASIDE,
    folder_aside,
    read_json,
    read_tensors,
    remove_leftovers,
    write_tensors,
    write_text,
    written_aside,
)
from tests.support.disk import file_limit
from tests.support.misaligned import ALIGNMENT, write_misaligned


def test_a_failed_writer_leaves_the_old_file_and_nothing_else(tmp_path):
    write_text(tmp_path / "a.txt", "old")
    with pytest.raises(FileNotFoundError), written_aside(tmp_path / "a.txt"):
        pass  # writes nothing, as with a full disk
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "old"


def test_tensors_are_read_into_memory_that_torch_allocated(tmp_path):
    tensors = {name: torch.randn(7, 5) for name in "abc"}
    write_misaligned(tmp_path / "a.safetensors", tensors)
    copies, _ = read_tensors(tmp_path / "a.safetensors")
    assert all(torch.equal(copies[name], tensor) for name, tensor in tensors.items())
    assert all(tensor.data_ptr() % ALIGNMENT == 0 for tensor in copies.values())


def test_a_truncated_tensor_file_is_one_line(tmp_path):
    path = tmp_path / "a.safetensors"
    write_tensors(path, {"a": torch.ones(100)})
    path.write_bytes(path.read_bytes()[:-50])
    with pytest.raises(CheckpointError, match=r"a\.safetensors: not a whole safetensors file") as error:
        read_tensors(path)
    assert "\n" not in str(error.value)


def test_a_missing_or_foreign_file_is_one_line(tmp_path):
    with pytest.raises(CheckpointError, match="no such file"):
        read_tensors(tmp_path / "b.safetensors")
    write_text(tmp_path / "a.json", "{")
    with pytest.raises(CheckpointError, match="not readable as JSON"):
        read_json(tmp_path / "a.json")


def test_writing_tensors_to_a_full_disk_is_an_os_error_and_leaves_no_file(tmp_path):
    with file_limit(1000), pytest.raises(OSError, match=r"too large: .*a\.safetensors"):
        write_tensors(tmp_path / "a.safetensors", {"a": torch.ones(10_000)})
    assert list(tmp_path.iterdir()) == []


def test_only_leftovers_of_the_given_name_are_removed(tmp_path):
    (tmp_path / f"{ASIDE}0123abcd-m").mkdir()
    for name in (f"{ASIDE}0123abcd-big-m", f"{ASIDE}0123abcd-m-big", "m"):
        (tmp_path / name).touch()
    remove_leftovers(tmp_path, "m")
    assert {path.name for path in tmp_path.iterdir()} == {f"{ASIDE}0123abcd-big-m", f"{ASIDE}0123abcd-m-big", "m"}
    remove_leftovers(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["m"]


def test_a_folder_written_aside_replaces_the_old_one_only_when_it_is_whole(tmp_path):
    for text in ("old", "new"):
        with folder_aside(tmp_path / "m") as folder:
            write_text(folder / "a.txt", text)
        assert (tmp_path / "m/a.txt").read_text() == text
    with pytest.raises(FileNotFoundError), folder_aside(tmp_path / "m") as folder:
        (folder / "a.txt").rename(folder / "b.txt")
    assert (tmp_path / "m/a.txt").read_text() == "new"
    assert [path.name for path in tmp_path.iterdir()] == ["m"]
