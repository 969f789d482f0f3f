"""Files are written whole or not at all, and damaged ones are errors of one line."""

from __future__ import annotations

import ntpath
import os
import stat
from pathlib import Path, PureWindowsPath

import pytest
import torch
from safetensors.torch import load_file, save_file

from persist_backbones.pipeline.pipeline import WorldPipeline
from persist_cli.checkpoints import save
from persist_cli.errors import CheckpointError, PersistError
from persist_cli.io import files
from persist_cli.io.checksums import with_row_checksums
from persist_cli.io.files import (
    ASIDE,
    check_folder,
    folder_aside,
    read_json,
    read_rows,
    read_tensors,
    relative_place,
    remove_leftovers,
    write_tensors,
    write_text,
    written_aside,
)
from persist_cli.io.sha256sums import check_sums, rewrite_files, write_sums
from tests.support.disk import file_limit
from tests.support.export_runs import write_base
from tests.support.micro_model import micro
from tests.support.misaligned import ALIGNMENT, write_misaligned
from tests.support.windows import as_on_windows


def test_a_failed_writer_leaves_the_old_file_and_nothing_else(tmp_path):
    write_text(tmp_path / "a.txt", "old")
    with pytest.raises(FileNotFoundError), written_aside(tmp_path / "a.txt"):
        pass  # writes nothing, as with a full disk
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "old"


def test_files_are_synced_and_have_the_hashes_that_are_listed_on_windows_too(tmp_path, monkeypatch):
    as_on_windows(monkeypatch)
    write_tensors(tmp_path / "a.safetensors", {"a": torch.ones(3)})
    write_text(tmp_path / "recipe.yaml", "a: 1\nb: 2\n")
    assert (tmp_path / "recipe.yaml").read_bytes() == b"a: 1\nb: 2\n"
    write_sums(tmp_path)
    rewrite_files({tmp_path: {"recipe.yaml": "a: 1\nb: 3\n"}})
    check_sums(tmp_path)
    assert b"\r" not in (tmp_path / "SHA256SUMS").read_bytes()


def test_places_and_fingerprints_are_the_same_text_on_windows(monkeypatch):
    weights = {"vae/a.safetensors": "00" * 32, "transformer/a.safetensors": "ff" * 32}
    here = save.fingerprint(weights)
    monkeypatch.setattr(save, "Path", PureWindowsPath)
    assert save.fingerprint(weights) == here
    monkeypatch.setattr(files, "Path", PureWindowsPath)
    monkeypatch.setattr(os.path, "relpath", ntpath.relpath)
    base, run = PureWindowsPath("C:/runs/stage1/model"), PureWindowsPath("C:/runs/voxel")
    assert relative_place(base, run) == "../stage1/model"
    assert relative_place(base, PureWindowsPath("D:/runs")) == "C:/runs/stage1/model"


def test_tensors_are_read_into_memory_that_torch_allocated(tmp_path):
    tensors = {name: torch.randn(7, 5) for name in "abc"}
    write_misaligned(tmp_path / "a.safetensors", tensors)
    copies, _ = read_tensors(tmp_path / "a.safetensors")
    assert all(torch.equal(copies[name], tensor) for name, tensor in tensors.items())
    assert all(tensor.data_ptr() % ALIGNMENT == 0 for tensor in copies.values())


TYPES = [torch.float64, torch.float32, torch.float16, torch.bfloat16, torch.int64, torch.uint8, torch.bool]


def test_rows_of_tensors_are_read_and_a_damaged_one_is_noticed_where_it_is_read(tmp_path):
    path = tmp_path / "a.safetensors"
    tensors = {"a": torch.arange(12.0).reshape(4, 3), "b": torch.arange(4).bfloat16()}
    write_tensors(path, with_row_checksums(tensors))
    assert all(torch.equal(rows, tensors[name][[3, 1]]) for name, rows in read_rows(path, [3, 1]).items())
    path.write_bytes(path.read_bytes().replace(tensors["a"][2].numpy().tobytes(), bytes(12)))
    assert torch.equal(read_rows(path, range(2))["a"], tensors["a"][:2])
    with pytest.raises(CheckpointError, match="damaged, its checksum is wrong"):
        read_rows(path, [1, 2])


def test_the_safetensors_package_reads_what_is_written(tmp_path):
    tensors = {str(kind): torch.tensor([[1, 0, 1], [0, 1, 1]], dtype=kind) for kind in TYPES}
    tensors |= {"scalar": torch.tensor(3.5), "empty": torch.zeros(0, 4), "ünïcode": torch.ones(3, dtype=torch.uint8)}
    write_tensors(tmp_path / "a.safetensors", tensors, {"b": "1", "a": "ü"})
    save_file(tensors, tmp_path / "b.safetensors")
    for name in "ab":
        read = load_file(tmp_path / f"{name}.safetensors")
        assert read.keys() == tensors.keys()
        assert all(torch.equal(read[key], value) and read[key].dtype == value.dtype for key, value in tensors.items())
    assert read_tensors(tmp_path / "a.safetensors")[1] == {"b": "1", "a": "ü"}


def test_equal_tensors_make_equal_files_whatever_their_order_in_memory(tmp_path):
    tensors = {"a": torch.arange(6.0).reshape(2, 3).t(), "b": torch.ones(3)}
    write_tensors(tmp_path / "a", tensors, {"x": "1", "y": "2"})
    backwards = {name: tensors[name].contiguous() for name in ("b", "a")}
    write_tensors(tmp_path / "b", backwards, {"y": "2", "x": "1"})
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_a_tensor_file_without_a_checksum_is_read_as_before(tmp_path):
    save_file({"a": torch.ones(3)}, tmp_path / "a.safetensors", {"b": "c"})
    tensors, metadata = read_tensors(tmp_path / "a.safetensors")
    assert torch.equal(tensors["a"], torch.ones(3))
    assert metadata == {"b": "c"}


def test_a_damaged_name_of_the_checksum_does_not_switch_it_off(tmp_path):
    path = tmp_path / "a.safetensors"
    write_tensors(path, {"a": torch.ones(3)})
    path.write_bytes(path.read_bytes().replace(b'"checksum"', b'"checksun"'))
    with pytest.raises(CheckpointError, match=r"a\.safetensors: damaged, its checksum is wrong"):
        read_tensors(path)


def test_tensors_of_a_type_that_safetensors_lacks_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"^a: safetensors has no type complex128$"):
        write_tensors(tmp_path / "a", {"a": torch.ones(2, dtype=torch.complex128)})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("mask", "mode"), [(0o022, 0o644), (0o007, 0o660)])
def test_all_files_follow_the_umask(tmp_path, mask, mode):
    before = os.umask(mask)
    try:
        write_base(tmp_path / "base")
        WorldPipeline.of(micro()).save_pretrained(tmp_path / "pipeline")
        write_tensors(tmp_path / "a.safetensors", {"a": torch.ones(3)})
        write_text(tmp_path / "a.txt", "a")
    finally:
        os.umask(before)
    modes = {path: stat.S_IMODE(path.stat().st_mode) for path in tmp_path.rglob("*") if path.is_file()}
    assert len(modes) > 10
    assert set(modes.values()) == {mode}, modes


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
    remove_leftovers(tmp_path, age=60)
    assert len(list(tmp_path.iterdir())) == 3
    remove_leftovers(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["m"]


def test_nothing_is_written_to_an_address(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for address in ("s3://bucket/houses", "https://host/x"):
        with pytest.raises(PersistError, match="an address; only folders of this machine are written into"):
            check_folder(Path(address))
    for folder in ("runs/s3:/x", "C:/houses", "s3:", "/s3:/x"):
        check_folder(Path(folder))
    (tmp_path / "s3:").mkdir()
    check_folder(Path("s3://bucket/houses"))  # a folder that is there


def test_a_failed_write_leaves_no_folder_that_was_made_for_it_and_every_other(tmp_path):
    (tmp_path / "there").mkdir()
    for place in ("new/deep/a.txt", "there/a.txt"):
        with pytest.raises(RuntimeError), written_aside(tmp_path / place):
            raise RuntimeError
    with pytest.raises(FileNotFoundError), written_aside(tmp_path / "shared/deep/a.txt"):
        (tmp_path / "shared" / "of another").touch()
    assert sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")) == [
        "shared", "shared/of another", "there"
    ]  # fmt: skip


def test_a_folder_written_aside_replaces_the_old_one_only_when_it_is_whole(tmp_path):
    for text in ("old", "new"):
        with folder_aside(tmp_path / "m") as folder:
            write_text(folder / "a.txt", text)
        assert (tmp_path / "m/a.txt").read_text() == text
    with pytest.raises(FileNotFoundError), folder_aside(tmp_path / "m") as folder:
        (folder / "a.txt").rename(folder / "b.txt")
    assert (tmp_path / "m/a.txt").read_text() == "new"
    assert [path.name for path in tmp_path.iterdir()] == ["m"]


@pytest.mark.parametrize("failure", [PermissionError, KeyboardInterrupt])
@pytest.mark.parametrize("place", [0, 1])
def test_the_old_folder_stays_when_the_new_one_cannot_be_put_in_its_place(tmp_path, monkeypatch, failure, place):
    with folder_aside(tmp_path / "m") as folder:
        write_text(folder / "a.txt", "old")
    renamed, targets = Path.rename, []

    def rename(path: Path, target: Path) -> Path:
        targets.append(target)
        if len(targets) == place + 1:  # as on Windows, where a file in the folder is open, or by Ctrl-C
            raise failure
        return renamed(path, target)

    monkeypatch.setattr(Path, "rename", rename)
    with pytest.raises(failure), folder_aside(tmp_path / "m") as folder:
        write_text(folder / "a.txt", "new")
    assert (tmp_path / "m/a.txt").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["m"]
