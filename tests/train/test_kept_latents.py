"""Latents of whole trajectories, which a codec that codes every frame alone keeps for all clips and segments."""

from __future__ import annotations

import pytest
import torch
from accelerate import Accelerator

from persist_cli.data.clips import ClipDataset, ClipPlan
from persist_cli.memorize.sources import Source
from persist_cli.train.clip_cache import CachedClips, CacheKeys, ClipCache, ClipEncoder
from persist_cli.train.tensor_cache import CacheSettings, TensorCache
from tests.support.micro_model import FRAMEWISE, micro
from tests.support.micro_runs import SIZE

KEYS = CacheKeys(latents={}, tokens=None, whole_trajectories=True)


@pytest.fixture
def cache(tmp_path) -> ClipCache:
    return ClipCache(TensorCache(CacheSettings(tmp_path, 1)), KEYS)


def clips_of(walks, own_writes: float) -> ClipDataset:
    """Clips of nine frames, each with nine before it where all are chained."""
    plan = ClipPlan(
        frames=9, strides=(1,), context_frames=0, seed=3, image_size=(SIZE, SIZE), own_writes=own_writes, segments=2
    )
    return ClipDataset([walks], plan)


def test_each_segment_has_the_latents_of_its_own_frames(walks, cache):
    clips, backbone, latents = clips_of(walks, own_writes=1.0), micro(**FRAMEWISE), []
    for kept in (None, cache, cache):  # without a cache, into it, and from it
        encoder = ClipEncoder(backbone, None, Accelerator(cpu=True), kept)
        sample = encoder.with_latents(CachedClips(clips, kept)[0]).sample
        latents.append([(clip.latents.video, clip.latents.image) for clip in (*sample.before, sample.clip)])
    for made in latents[1:]:
        torch.testing.assert_close(made, latents[0], rtol=1e-4, atol=1e-4)
    before, clip = latents[0]
    assert not torch.allclose(before[0], clip[0], atol=1e-2)


def test_a_trajectory_is_encoded_once_though_many_of_its_clips_were_read_before(walks, cache, monkeypatch):
    encoder, encoded = ClipEncoder(micro(**FRAMEWISE), None, Accelerator(cpu=True), cache), []
    pieces = Source.pieces
    monkeypatch.setattr(Source, "pieces", lambda source: encoded.append(source.file.path) or pieces(source))
    clips = CachedClips(clips_of(walks, own_writes=0.0), cache)
    for read in [clips[number] for number in range(5)]:
        assert read.sample.clip.latents is None
        encoder.with_latents(read)
    assert len(encoded) == len({*encoded}) == 2
