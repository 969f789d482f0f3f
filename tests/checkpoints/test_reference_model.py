"""The bundled reference model is whole, small enough for git, and better with its memory than without."""

from __future__ import annotations

import json

import pytest

from persist_cli.api.checkpoint import find_checkpoint, reference_checkpoint
from persist_cli.checkpoints.lineage import training_scenes
from persist_cli.checkpoints.load import empty_backbone
from tests.support.packaged_models import check_files, check_sample_is_unseen

MOST_BYTES = 40e6

BACK = ("--start", "sample#0:32", "--follow", "--frames", 16, "--seed", 0)


@pytest.fixture
def packaged(monkeypatch):
    """The folder in the package; other tests use a folder of their own."""
    monkeypatch.delenv("PERSIST_REFERENCE")
    return reference_checkpoint()


def test_every_file_has_its_hash_and_all_are_small_enough(packaged):
    check_files(packaged, MOST_BYTES)


def test_what_is_invented_in_evaluations_is_sampled_away_from_its_guide(packaged):
    checkpoint = find_checkpoint(packaged)
    weights = {name: sampling.autoguidance for name, sampling in checkpoint.protocol_sampling.items()}
    assert weights == {"return": 3.0, "long": 3.0}
    for sampling in checkpoint.protocol_sampling.values():
        empty_backbone(checkpoint).check_sampling(sampling)


def test_the_sample_shows_houses_that_it_was_not_trained_on(packaged):
    check_sample_is_unseen(training_scenes(find_checkpoint(packaged)))


def test_with_memory_the_way_back_is_closer_to_the_truth_than_without(packaged, persist, tmp_path):
    assert persist("memorize", "sample#0:0-33", "--out", tmp_path / "house.safetensors").code == 0
    means = []
    for options in (("--memory", tmp_path / "house.safetensors"), ("--adapter", "none")):
        ended = persist("rollout", *BACK, *options, "--out", tmp_path / "back")
        assert ended.code == 0, ended.err
        psnr = json.loads((tmp_path / "back/rollout.json").read_text())["against_ground_truth"]["psnr"]
        means.append(sum(psnr) / len(psnr))
    assert means[0] > means[1] + 3
