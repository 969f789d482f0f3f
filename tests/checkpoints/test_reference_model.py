"""The bundled models are whole, small enough for git, and better with their memory than without."""

from __future__ import annotations

import json

import pytest

from persist_cli.api.backbone import Sampling
from persist_cli.api.checkpoint import ONE_STEP, PACKAGED, find_checkpoint, packaged_checkpoint, reference_checkpoint
from persist_cli.api.inference import CONSISTENCY
from persist_cli.checkpoints.lineage import training_scenes
from persist_cli.checkpoints.load import adapter_memory, empty_backbone
from tests.support.packaged_models import check_files, check_sample_is_unseen

MOST_BYTES = {"reference": 25e6, "reference-1step": 15e6}  # 40 MB together

BACK = ("--start", "sample#0:32", "--follow", "--frames", 16, "--seed", 0)


@pytest.fixture
def packaged(monkeypatch):
    """The folder in the package; other tests use a folder of their own."""
    monkeypatch.delenv("PERSIST_REFERENCE")
    return reference_checkpoint()


@pytest.mark.parametrize("name", PACKAGED)
def test_every_file_has_its_hash_and_all_are_small_enough(packaged, name):
    check_files(packaged_checkpoint(name), MOST_BYTES[name])


def test_the_distilled_model_takes_one_step_and_has_the_same_memories(packaged):
    whole, distilled = find_checkpoint(packaged), find_checkpoint(packaged_checkpoint(ONE_STEP))
    assert distilled.sampling == Sampling(1, CONSISTENCY)
    assert distilled.default == whole.default
    memories = [{name: adapter_memory(one, name) for name in one.adapters} for one in (whole, distilled)]
    assert memories[0] == memories[1]


def test_what_is_invented_in_evaluations_is_sampled_away_from_its_guide(packaged):
    checkpoint = find_checkpoint(packaged)
    weights = {name: sampling.autoguidance for name, sampling in checkpoint.protocol_sampling.items()}
    assert weights == {"return": 3.0, "long": 3.0}
    for sampling in checkpoint.protocol_sampling.values():
        empty_backbone(checkpoint).check_sampling(sampling)


@pytest.mark.parametrize("name", PACKAGED)
def test_the_sample_shows_houses_that_it_was_not_trained_on(packaged, name):
    check_sample_is_unseen(training_scenes(find_checkpoint(packaged_checkpoint(name))))


@pytest.mark.parametrize("name", PACKAGED)
def test_with_memory_the_way_back_is_closer_to_the_truth_than_without(packaged, persist, tmp_path, name):
    assert persist("memorize", "sample#0:0-33", "--out", tmp_path / "house.safetensors").code == 0
    means = []
    for options in (("--memory", tmp_path / "house.safetensors"), ("--adapter", "none")):
        ended = persist("rollout", name, *BACK, *options, "--out", tmp_path / "back")
        assert ended.code == 0, ended.err
        psnr = json.loads((tmp_path / "back/rollout.json").read_text())["against_ground_truth"]["psnr"]
        means.append(sum(psnr) / len(psnr))
    assert means[0] > means[1] + 3
