"""A data set at an address is listed, fetched as far as it is read, and fetched again when it changes."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import fsspec
import pytest
import torch
from fsspec.registry import _registry

from persist_cli.data import mirror as mirrors
from persist_cli.data.mirror import HEADERS, LIST, mirror
from persist_cli.data.parquet import SUFFIX
from persist_cli.data.reference import data_folder, parse_reference
from persist_cli.data.store import Store
from persist_cli.errors import DataError
from persist_cli.io.files import ASIDE
from tests.support.data_server import REPOSITORY, DataServer, serving
from tests.support.disk import file_limit
from tests.support.micro_runs import equal_runs, stage


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of mirrors; the ends of files are short, so that no file of the tests is in one."""
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(mirrors, "WAITS", (0.0, 0.0))
    monkeypatch.setattr(mirrors, "END", 1024)
    mirror.cache_clear()
    return tmp_path / "cache"


@pytest.fixture
def houses(walks: Path, tmp_path: Path) -> Path:
    """The folder that is served."""
    return Path(shutil.copytree(walks, tmp_path / "houses"))


@pytest.fixture
def server(houses: Path) -> Iterator[DataServer]:
    with serving(houses) as served:
        yield served


def names(folder: Path) -> list[str]:
    """Names of the trajectories in a folder."""
    return sorted(path.name for path in folder.glob(f"*{SUFFIX}"))


def test_lengths_cameras_and_sizes_need_no_whole_file(server: DataServer, houses: Path) -> None:
    near, far = Store(houses), Store(data_folder(server.address))
    assert far.names == near.names
    for one, other in zip(near, far, strict=True):
        assert (one.length, one.info.scene, one.file_size) == (other.length, other.info.scene, other.file_size)
        assert one.info.vocabulary == other.info.vocabulary
    assert server.whole() == names(far.folder) == []


def test_a_trajectory_is_fetched_when_its_frames_are_read_and_only_once(server: DataServer, houses: Path) -> None:
    reference = parse_reference(f"{server.address}#1:3-7")
    (read,), (true,) = reference.read(), parse_reference(f"{houses}#1:3-7").read()
    assert torch.equal(read.observations.rgb, true.observations.rgb)
    assert torch.equal(read.observations.depth, true.observations.depth)
    assert torch.equal(read.observations.cameras.centers, true.observations.cameras.centers)
    reference.read()
    assert server.whole() == names(reference.folder) == ["walk-1.parquet"]
    assert reference.single().sha256 == Store(houses)[1].sha256


def test_a_process_asks_once_what_is_there(server: DataServer) -> None:
    folder = data_folder(server.address)
    asked = len(server.asked)
    assert (data_folder(server.address), len(server.asked)) == (folder, asked)


def test_what_changed_at_the_address_is_fetched_again(server: DataServer, houses: Path, held_out: Path) -> None:
    before = Store(data_folder(server.address))
    assert [file.sha256 for file in before] == [file.sha256 for file in Store(houses)]
    shutil.copy(held_out / "loop-0.parquet", houses / "walk-0.parquet")
    shutil.copy(held_out / "loop-1.parquet", houses / "loop-1.parquet")
    mirror.cache_clear()
    after = Store(data_folder(server.address))
    assert names(after.folder) == ["walk-1.parquet"]  # as before
    assert after.names == ["loop-1", "walk-0", "walk-1"]
    assert after["walk-0"].info.scene == "held-out-0"
    assert [file.sha256 for file in after] == [file.sha256 for file in Store(houses)]


def test_what_changed_without_another_size_is_fetched_again(server: DataServer, houses: Path) -> None:
    path = houses / "walk-0.parquet"
    before = Store(data_folder(server.address))[0].sha256
    path.write_bytes(b"\xff" + path.read_bytes()[1:])
    os.utime(path, (0, 0))  # the server tells files apart by their times alone
    mirror.cache_clear()
    assert before != Store(data_folder(server.address))[0].sha256 == Store(houses)[0].sha256


def test_a_server_that_sends_no_parts_sends_whole_files(houses: Path) -> None:
    with serving(houses, ranges=False) as server:
        store = Store(data_folder(server.address))
        assert [file.sha256 for file in store] == [file.sha256 for file in Store(houses)]
        assert not (store.folder / HEADERS).exists()


def test_a_header_longer_than_what_is_read_at_first_is_read_whole(
    server: DataServer, houses: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mirrors, "END", 16)
    store = Store(data_folder(server.address))
    assert [file.length for file in store] == [file.length for file in Store(houses)]
    assert server.whole() == []


def test_what_is_known_is_used_when_the_address_is_out_of_reach(
    houses: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with serving(houses) as server:
        Store(data_folder(server.address))[0].read()
    mirror.cache_clear()
    capsys.readouterr()
    store = Store(data_folder(server.address))
    assert "what is known of it from before is used" in capsys.readouterr().err
    assert torch.equal(store[0].poses(), Store(houses)[0].poses())
    with pytest.raises(DataError, match=r"^http://127.0.0.1:\d+/houses/walk-1.parquet: cannot be read \(.*connect"):
        store[1].read()
    assert names(store.folder) == ["walk-0.parquet"]


def test_a_server_that_fails_for_a_moment_is_asked_again(server: DataServer, houses: Path) -> None:
    server.failures = 2
    store = Store(data_folder(server.address))
    server.failures = 2
    assert store[0].sha256 == Store(houses)[0].sha256
    server.failures = 9
    with pytest.raises(DataError, match=r"walk-1.parquet: cannot be read \(503"):
        store[1].read()


def test_a_file_of_another_size_than_listed_is_not_kept(server: DataServer, houses: Path) -> None:
    store = Store(data_folder(server.address))
    with (houses / "walk-0.parquet").open("ab") as file:
        file.write(b"more")
    with pytest.raises(DataError, match=r"walk-0.parquet: \d+ bytes came, \d+ were listed; try again$"):
        store[0].read()
    server.cut = 100
    with pytest.raises(DataError, match=r"walk-1.parquet: cannot be read \("):
        store[1].read()
    assert [path.name for path in store.folder.rglob("*") if path.name.startswith(ASIDE)] == []
    assert names(store.folder) == []


@pytest.mark.parametrize("content", [b"", b"PAR1", bytes(5000), b"PAR1" + bytes(5000) + b"\xff\xff\xff\x7fPAR1"])
def test_a_damaged_file_is_reported_as_one(server: DataServer, houses: Path, content: bytes) -> None:
    (houses / "walk-0.parquet").write_bytes(content)
    store = Store(data_folder(server.address))
    with pytest.raises(DataError, match=r"walk-0.parquet: not a whole Parquet file \("):
        _ = store[0].length
    assert store[1].length == 24


def test_only_plain_names_of_trajectories_are_listed(server: DataServer, houses: Path) -> None:
    for name in (".hidden.parquet", f"{ASIDE}x.parquet", "notes.txt", "..%2Fup.parquet"):
        (houses / name).write_bytes(b"x")
    (houses / "folder.parquet").mkdir()
    (houses / "walk-0.parquet").rename(houses / "a walk.parquet")
    store = Store(data_folder(server.address))
    assert store.names == ["a walk", "walk-1"]
    assert store[0].length == 24
    assert len(store[0].read().actions) == 24


def test_other_file_systems_of_fsspec_are_read_in_the_same_way(houses: Path) -> None:
    memory = fsspec.filesystem("memory")
    memory.put(str(houses), "/bucket/houses", recursive=True)
    try:
        store = Store(data_folder("memory://bucket/houses"))
        assert [file.sha256 for file in store] == [file.sha256 for file in Store(houses)]
    finally:
        memory.rm("/bucket", recursive=True)


def test_the_client_of_the_hub_is_asked_for_its_addresses(server: DataServer, houses: Path, cache: Path) -> None:
    read = (
        "from persist_cli.data.reference import data_folder; from persist_cli.data.store import Store;"
        f"store = Store(data_folder('hf://datasets/{REPOSITORY}/houses'));"
        "print([file.length for file in store], store[1].sha256)"
    )
    hub = {"HF_ENDPOINT": server.address.removesuffix("/houses"), "HF_HUB_OFFLINE": "0", "PERSIST_CACHE": str(cache)}
    said = subprocess.run(
        [sys.executable, "-c", read], env=os.environ | hub, capture_output=True, text=True, check=True
    )
    assert said.stdout == f"[24, 24] {Store(houses)[1].sha256}\n"
    assert server.whole() == names(next((cache / "data").iterdir())) == ["walk-1.parquet"]


@pytest.mark.parametrize(
    ("address", "cause"),
    [
        ("{}/none", "/none: nothing is there"),
        ("{}/empty", r"/empty: no trajectory in it \(\*.parquet\)"),
        ("nonsense://x/y", r"nonsense://x/y: cannot be read \(Protocol not known: nonsense\)"),
        ("s3://bucket/houses", "s3://bucket/houses: Install s3fs to access S3; it is no part of persist"),
    ],
)
def test_an_address_that_cannot_be_listed_is_an_error_and_leaves_nothing(
    server: DataServer, houses: Path, cache: Path, address: str, cause: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "s3fs", None)
    (houses / "empty").mkdir()
    with pytest.raises(DataError, match=f"{cause}$"):
        data_folder(address.format(server.address))
    assert not cache.exists()


def test_a_missing_package_is_named(server: DataServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "aiohttp", None)
    monkeypatch.delitem(sys.modules, "fsspec.implementations.http", raising=False)
    monkeypatch.delitem(_registry, "http", raising=False)
    with pytest.raises(DataError, match=r"aiohttp.*; pip install 'persist-cli\[http\]'$"):
        data_folder(server.address)


def test_a_mirror_that_cannot_be_written_is_an_error(server: DataServer, cache: Path) -> None:
    cache.write_text("no folder")
    with pytest.raises(DataError, match=r"nothing of http://.* can be kept there \(Not a directory\)$"):
        data_folder(server.address)


def test_a_full_disk_is_said_of_the_mirror_and_leaves_no_part(server: DataServer) -> None:
    store = Store(data_folder(server.address))
    with (
        file_limit(2000),
        pytest.raises(DataError, match=r"cache/.*/walk-0.parquet: cannot be written \(File too large\)$"),
    ):
        store[0].read()
    assert names(store.folder) == []
    assert [path.name for path in store.folder.rglob("*") if path.name.startswith(ASIDE)] == []


def test_a_list_of_another_version_is_an_error(server: DataServer) -> None:
    folder = data_folder(server.address)
    (folder / LIST).write_text('{"address": "x", "files": {"walk-0.parquet": {"place": "x"}}}')
    with pytest.raises(DataError, match=r"mirror.json: not a list of this version; delete .*/houses-"):
        Store(folder)


def test_a_training_by_address_equals_one_of_the_folder(server, houses, codec, tmp_path, persist) -> None:
    base, changes = f"base={codec}", ("training.workers=1", "training.precision=no")
    near = stage("stage1", houses, tmp_path / "near", base, *changes)
    far = [server.address if word == str(houses) else word for word in near]
    far[far.index(str(tmp_path / "near"))] = str(tmp_path / "far")
    assert persist(*near).code == 0
    ended = persist(*far, "training.steps=2")
    assert ended.code == 0, ended.err
    assert server.address in (tmp_path / "far/recipe.yaml").read_text()
    mirror.cache_clear()
    assert persist(*far, "--resume").code == 0
    assert equal_runs(tmp_path / "near", tmp_path / "far")


def test_an_evaluation_by_address_says_the_address(server, houses, held_out, stage1, tmp_path, persist) -> None:
    shutil.rmtree(houses)
    shutil.copytree(held_out, houses)
    options = ["--metrics", "psnr", "--clips", "2", "--seeds", "1", "--steps", "1", "--json"]
    ended = persist("eval", stage1, "--data", server.address, *options, "--out", tmp_path / "eval")
    assert ended.code == 0, ended.err
    assert f'"address": "{server.address}"' in ended.out
