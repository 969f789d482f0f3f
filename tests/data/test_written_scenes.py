"""Scenes that were written once are taken from a cache, and only where they would be written the same."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from persist_cli.api.observations import Frame
from persist_cli.data import store
from persist_cli.data.file_hashes import FileHashes
from persist_cli.data.store import Store, TrajectoryFile, write_trajectory
from persist_cli.data.written_scenes import SceneWriter
from tests.support.cell_houses import FORM, write_cell_houses


class Kept(dict[str, dict[str, torch.Tensor]]):
    """A cache in memory."""

    put = dict.__setitem__

    @property
    def hashes(self) -> FileHashes:
        return FileHashes()  # of a process of its own


def house(folder: Path, size: int) -> TrajectoryFile:
    return next(iter(Store(write_cell_houses(folder, [5], size=size))))


@pytest.mark.parametrize("first", [32, 64])
def test_a_kept_scene_is_not_taken_for_that_of_frames_of_another_size(tmp_path: Path, first: int) -> None:
    kept, files = Kept(), {size: house(tmp_path / str(size) / "data", size) for size in (32, 64)}
    for size in (first, 96 - first):
        known = SceneWriter(FORM, kept).scene(files[size], [3]).known
        assert torch.equal(known.classes, SceneWriter(FORM).scene(files[size], [3]).known.classes)
    assert len(kept) == 2


def test_a_kept_scene_is_not_taken_for_that_of_a_file_whose_depth_was_mended(tmp_path: Path) -> None:
    kept, file = Kept(), house(tmp_path / "data", 32)
    SceneWriter(FORM, kept).scene(file, [3])
    seen, info = file.read().observations, file.info
    frames = zip(seen.rgb.numpy(), seen.depth.numpy() / 2, seen.cameras.world_from_camera.numpy(), strict=True)
    write_trajectory(file.path, info, [Frame(*frame, action="left") for frame in frames])
    mended = TrajectoryFile(file.path)
    known = SceneWriter(FORM, kept).scene(mended, [3]).known
    assert torch.equal(known.classes, SceneWriter(FORM).scene(mended, [3]).known.classes)
    assert len(kept) == 2


def test_the_hash_of_a_file_is_that_which_the_cache_has(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept, file = Kept(), house(tmp_path / "data", 32)
    monkeypatch.setattr(Kept, "hashes", FileHashes())
    SceneWriter(FORM, kept).scene(file, [3])
    monkeypatch.delattr(store, "file_sha256")
    SceneWriter(FORM, kept).scene(file, [3])
    assert len(kept) == 1


def test_a_kept_scene_is_taken_again(tmp_path: Path) -> None:
    kept, file = Kept(), house(tmp_path / "data", 32)
    known = [SceneWriter(FORM, kept).scene(file, [3]).known for _ in range(2)]
    assert torch.equal(known[0].classes, known[1].classes)
    assert len(kept) == 1


def test_a_kept_scene_is_not_taken_for_that_of_more_frames_and_the_view_is_the_newest(tmp_path: Path) -> None:
    kept, file = Kept(), house(tmp_path / "data", 32)
    one, more = (SceneWriter(FORM, kept).scene(file, frames) for frames in ([9], [0, 4, 9]))
    assert int(more.known.known.sum()) > int(one.known.known.sum())
    assert torch.equal(more.view.rgb, file.read([9]).observations.rgb)
