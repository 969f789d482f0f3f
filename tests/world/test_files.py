import pytest
import torch

from persist_cli.world.errors import CheckpointError
from persist_cli.world.files import read_json, read_tensors, write_tensors, write_text, written_aside


def test_a_failed_writer_leaves_the_old_file_and_nothing_else(tmp_path):
    write_text(tmp_path / "a.txt", "old")
    with pytest.raises(FileNotFoundError), written_aside(tmp_path / "a.txt"):
        pass  # nothing was written aside, as when a disk is full
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "old"


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
