"""A cache of features: a trajectory is encoded once, and a sample reads what its context has and no more."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from persist_cli.api.encoder import Encoder
from persist_cli.data.store import Store, TrajectoryFile
from persist_cli.memorize.kept_features import KeptFeatures, frame_digests
from persist_cli.plugins import make_encoder
from persist_cli.train.clip_cache import CacheKeys, ClipCache
from persist_cli.train.feature_cache import FeatureCache
from persist_cli.train.tensor_cache import CacheSettings, TensorCache

PLAIN = make_encoder("patches", {})


class Counting(Encoder):
    """An encoder that counts the frames it encodes."""

    name, frames, channels = "counting", 0, 32

    def encode(self, rgb):
        self.frames += len(rgb)
        return PLAIN.encode(rgb)


@pytest.fixture
def file(walks: Path) -> TrajectoryFile:
    return Store(walks)[0]


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The number of frames whose features each look into a cache gives."""
    counts: list[int] = []
    get = TensorCache.get

    def counted(*arguments):
        tensors = get(*arguments)
        counts.append(0 if tensors is None else len(tensors["features"]))
        return tensors

    monkeypatch.setattr(TensorCache, "get", counted)
    return counts


def feature_cache(folder: Path, file: TrajectoryFile, frames: int, **depends: str) -> FeatureCache:
    """A cache whose encoder has room for the features of some frames."""
    room = frames * PLAIN.encode(file.rgb([0])).nbytes
    return FeatureCache(TensorCache(CacheSettings(folder, 1)), depends, KeptFeatures(Counting(None), room))


def test_the_features_of_contexts_are_read_though_there_is_no_room_for_those_of_the_trajectory(file, tmp_path, reads):
    cache = feature_cache(tmp_path, file, frames=6)
    for context in (range(6), range(6, 12), [11, 0, 3], range(6)):
        cache.bring(file, context)
        assert torch.equal(cache.encoder.encode(file.rgb(context)), PLAIN.encode(file.rgb(context)))
    assert cache.encoder.encoder.frames == len({*frame_digests(file.rgb(range(len(file))))})
    assert reads == [0, 6, 2, 4]


def test_another_process_reads_the_same_features_and_encodes_none(file, tmp_path, reads):
    feature_cache(tmp_path, file, frames=6).bring(file, [0])
    cache = feature_cache(tmp_path, file, frames=6)
    cache.bring(file, [5, 2])
    assert torch.equal(cache.encoder.encode(file.rgb([2, 5])), PLAIN.encode(file.rgb([2, 5])))
    assert (cache.encoder.encoder.frames, reads) == (0, [0, 2])


def test_other_trajectories_and_what_else_features_depend_on_have_entries_of_their_own(walks, tmp_path, reads):
    one, other = Store(walks)
    for file, weights in ((one, "a"), (other, "a"), (one, "b")):
        feature_cache(tmp_path, file, frames=6, weights=weights).bring(file, [0])
    feature_cache(tmp_path, other, frames=6, weights="a").bring(other, [0])
    assert reads == [0, 0, 0, 1]
    assert len([*tmp_path.glob("*/*.safetensors")]) == 3


def test_features_depend_on_the_encoder_and_not_on_the_memory_that_reads_them(tmp_path):
    of_the_encoder = {
        "persist", "torch", "device", "encoder", "encoder_settings", "encoder_code", "features", "packages",
    }  # fmt: skip
    of_others = ("memory", "memory_code", "settings", "budget", "noise", "kept", "backbone_code", "precision")
    tokens = dict.fromkeys((*of_the_encoder, *of_others), "")
    keys = CacheKeys(latents={}, tokens=tokens, whole_trajectories=False)
    factory: Any = SimpleNamespace(encoder=KeptFeatures(Counting(None)))
    features = ClipCache.of(TensorCache(CacheSettings(tmp_path, 1)), keys, factory).features
    assert features.depends.keys() == of_the_encoder


def test_features_that_a_context_has_do_not_leave_for_those_that_it_lacks(file, tmp_path, reads):
    cache = feature_cache(tmp_path, file, frames=4)
    for context in ([11, 0, 1, 2], [11, 8, 9], [11]):
        cache.bring(file, context)
    assert reads == [0, 2]


def test_features_that_are_damaged_are_made_anew(file, tmp_path, capsys):
    feature_cache(tmp_path, file, frames=6).bring(file, [0])
    (entry,) = tmp_path.glob("*/*.safetensors")
    whole, place = entry.read_bytes(), PLAIN.encode(file.rgb(range(8)))[3].numpy().tobytes()
    first = whole.index(place)
    entry.write_bytes(whole[:first] + bytes([whole[first] ^ 1]) + whole[first + 1 :])
    cache = feature_cache(tmp_path, file, frames=6)
    cache.bring(file, [2, 3])
    assert "its checksum is wrong" in capsys.readouterr().out
    assert torch.equal(cache.encoder.encode(file.rgb([2, 3])), PLAIN.encode(file.rgb([2, 3])))
    assert entry.read_bytes() == whole
