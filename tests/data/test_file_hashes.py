"""Hashes of data files are kept beside what is made of them, and never those of what a file held before."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from persist_cli.data import file_hashes, store
from persist_cli.data.file_hashes import FileHashes
from persist_cli.data.store import TrajectoryFile


@pytest.fixture
def file(tmp_path: Path) -> TrajectoryFile:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "a.parquet").write_bytes(b"old")
    return TrajectoryFile(tmp_path / "data" / "a.parquet")


@pytest.fixture
def hashed(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The files of which hashes are computed."""
    paths: list[Path] = []
    file_sha256 = store.file_sha256
    monkeypatch.setattr(store, "file_sha256", lambda path: paths.append(path) or file_sha256(path))
    return paths


@pytest.fixture
def later(monkeypatch: pytest.MonkeyPatch) -> None:
    """No file is too new."""
    monkeypatch.setattr(file_hashes, "RACY", -1.0)


def rewrite(file: TrajectoryFile, content: bytes) -> None:
    """Write into a file in such a way that its time of modification stays the same."""
    before = file.path.stat()
    file.path.write_bytes(content)
    os.utime(file.path, ns=(before.st_atime_ns, before.st_mtime_ns))


@pytest.mark.usefixtures("later")
def test_processes_that_share_a_folder_compute_a_hash_once(file, hashed, tmp_path):
    known = FileHashes()
    expected = {known.of(file), known.of(TrajectoryFile(file.path))}
    assert len(hashed) == 1
    assert {FileHashes(tmp_path / "cache").of(file) for _ in range(3)} == expected
    assert len(hashed) == 2
    (kept,) = (tmp_path / "cache").glob("*/*")
    assert kept.read_text() == expected.pop()


@pytest.mark.usefixtures("later")
@pytest.mark.parametrize("content", [b"new", b"longer"])
def test_a_file_that_has_changed_is_hashed_anew(file, hashed, tmp_path, content):
    FileHashes(tmp_path / "cache").of(file)
    rewrite(file, content)
    assert FileHashes(tmp_path / "cache").of(file) == file.sha256 == FileHashes().of(file)
    assert len(hashed) == 4


def test_the_hash_of_a_file_that_is_too_new_is_not_kept(file, tmp_path, monkeypatch):
    now = time.time_ns()  # which the file system tells so coarsely that it stays the same
    monkeypatch.setattr(file_hashes, "_state", lambda path: (str(path), 3, now, now))
    monkeypatch.setattr(file_hashes, "RACY", 600.0)
    FileHashes(tmp_path / "cache").of(file)
    rewrite(file, b"new")
    assert FileHashes(tmp_path / "cache").of(file) == file.sha256
    assert not (tmp_path / "cache").exists()


@pytest.mark.usefixtures("later")
def test_the_hash_of_a_file_that_changes_meanwhile_is_not_kept(file, tmp_path, monkeypatch):
    monkeypatch.setattr(store, "file_sha256", lambda _: rewrite(file, b"newer") or "0" * 64)
    FileHashes(tmp_path / "cache").of(file)
    assert not (tmp_path / "cache").exists()


@pytest.mark.usefixtures("later")
@pytest.mark.parametrize("damaged", [b"", b"\xff" * 64, b"0" * 63])
def test_a_damaged_hash_is_computed_anew(file, tmp_path, damaged):
    FileHashes(tmp_path / "cache").of(file)
    (kept,) = (tmp_path / "cache").glob("*/*")
    kept.write_bytes(damaged)
    assert FileHashes(tmp_path / "cache").of(file) == file.sha256 == kept.read_text()


@pytest.mark.usefixtures("later")
def test_where_nothing_can_be_kept_hashes_are_computed_all_the_same(file, tmp_path):
    (tmp_path / "cache").write_text("")
    assert FileHashes(tmp_path / "cache").of(file) == file.sha256
