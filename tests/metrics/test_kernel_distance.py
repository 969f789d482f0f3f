"""The kernel distance of single frames, of which pairs within a scene are left out."""

from __future__ import annotations

import itertools

import pytest
import torch

from persist_cli.metrics import METRICS
from tests.metrics.test_src import cache_random_encoder
from tests.support.predictions import random_frames, setup

DISTANCE = METRICS["kd-dinov2"]


def draws(seed, scenes=8, shift=0.0):
    """Features of three frames in each scene, and the scenes' numbers."""
    numbers = torch.arange(scenes).repeat_interleave(3)
    features = torch.randn(len(numbers), 4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return features + shift, numbers


def distance(generated, true, scenes, counts=None):
    """The distance of scenes that are counted so often, by default once."""
    sums, pairs = DISTANCE.scene_sums(generated, true, scenes)
    weights = torch.ones(len(sums), dtype=torch.float64) if counts is None else counts
    return float(weights @ sums @ weights / (weights @ pairs @ weights))


def test_it_is_the_mean_over_pairs_of_frames_of_two_scenes():
    (generated, scenes), (true, _) = draws(0, scenes=3), draws(1, scenes=3)

    def kernel(one, two):
        return (float(one @ two) / 4 + 1) ** 3

    values = [
        kernel(generated[i], generated[j]) + kernel(true[i], true[j]) - 2 * kernel(generated[i], true[j])
        for i, j in itertools.permutations(range(9), 2)
        if scenes[i] != scenes[j]
    ]
    assert distance(generated, true, scenes) == pytest.approx(1000 * sum(values) / len(values))


def test_equal_distributions_are_at_zero_on_average_and_others_are_apart():
    equal = [distance(draws(2 * n)[0], *draws(2 * n + 1)) for n in range(200)]
    apart = [distance(draws(2 * n, shift=0.5)[0], *draws(2 * n + 1)) for n in range(200)]
    error = torch.tensor(equal).std() / 200**0.5
    assert abs(torch.tensor(equal).mean()) < 3 * error
    assert torch.tensor(apart).mean() > 10 * error


def test_a_scene_that_is_counted_twice_is_no_pair_with_itself():
    (generated, scenes), (true, _) = draws(0, scenes=3), draws(1, scenes=3)
    kept = scenes < 2
    twice = distance(generated, true, scenes, torch.tensor([2.0, 1.0, 0.0]).double())
    assert twice == pytest.approx(distance(generated[kept], true[kept], scenes[kept]))


def test_frames_have_features_of_their_own_and_two_scenes_are_needed(tmp_path, monkeypatch):
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path))
    assert "0 scenes have frames" in str(DISTANCE.obstacle(setup()))
    assert "persist weights fetch" in str(DISTANCE.obstacle(setup(unseen_scenes=2)))
    cache_random_encoder(tmp_path / "weights" / "dinov2-s-derived")
    assert DISTANCE.obstacle(setup(unseen_scenes=2)) is None
    features = DISTANCE.features(random_frames(0, 3)[0])
    assert features.shape == (3, 24)
    assert "no FID" in DISTANCE.definition
