"""NoMaD's published weights become a trained policy. The file is made here: the real one was never at hand."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
import torch

from persist_cli.io.files import read_tensors
from persist_cli.policies.open_policy import open_policy
from persist_cli.weights.conversion import CONVERSIONS
from tests.support.published_nomad import published_tensors


@pytest.fixture
def original(tmp_path, monkeypatch) -> Path:
    """A folder with a file of the published names and shapes, and an empty cache."""
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("PERSIST_WEIGHTS", raising=False)
    (tmp_path / "original").mkdir()
    torch.save(published_tensors(), tmp_path / "original/nomad.pth")
    return tmp_path / "original"


def test_every_tensor_comes_under_its_new_name(original):
    ours, published = CONVERSIONS["nomad"](original / "nomad.pth"), published_tensors()
    names = {float(value.flatten()[0]): name for name, value in published.items()}
    assert len(ours) == len({float(value.flatten()[0]) for value in ours.values()})
    left_out = {name for name in published} - {names[float(value.flatten()[0])] for value in ours.values()}
    assert {name.split(".")[1] for name in left_out} == {
        "obs_encoder",
        "goal_encoder",
        "positional_encoding",
        "sa_layer",
    }
    pairs = {name: names[float(value.flatten()[0])] for name, value in ours.items()}
    assert pairs["seen_encoder.blocks.3.excite.bias"] == "vision_encoder.obs_encoder._blocks.3._se_expand.bias"
    assert pairs["goal_encoder.head_norm.weight"] == "vision_encoder.goal_encoder._bn1.weight"
    assert pairs["noise.up.1.second.condition.1.weight"] == "noise_pred_net.up_modules.1.1.cond_encoder.1.weight"
    assert pairs["noise.down.0.first.second.0.bias"] == "noise_pred_net.down_modules.0.0.blocks.1.block.0.bias"
    assert pairs["distance.4.weight"] == "dist_pred_net.network.4.weight"


def test_the_fetched_weights_are_a_policy_that_opens_by_their_folder(persist, original):
    sha256 = hashlib.sha256((original / "nomad.pth").read_bytes()).hexdigest()
    assert persist("weights", "fetch", "nomad", "--from", original, "--sha256", sha256).code == 0
    folder = persist("weights", "path", "nomad").out.strip()
    policy = open_policy(folder)
    assert (policy.name, policy.frames, policy.longest) == ("nomad", 4, 8)
    state, kept = policy.network.state_dict(), read_tensors(Path(folder) / "model.safetensors")[0]
    assert all(state[name].equal(value) for name, value in kept.items())


def test_they_are_refused_without_a_hash_and_with_another(persist, original, tmp_path):
    for hashes, message in (
        ((), "refused without a hash; that of nomad.pth is not known here"),
        (("--sha256", "0" * 64), "refused, its SHA-256 is"),
        (("--sha256", "abc"), "a SHA-256 has 64 digits"),
    ):
        ended = persist("weights", "fetch", "nomad", "--from", original, *hashes)
        assert (ended.code, message in ended.err, ended.err.count("\n")) == (1, True, 1)
    assert not (tmp_path / "cache/weights/nomad").exists()
    ended = persist("weights", "fetch", "lpips-alex", "--from", original, "--sha256", "0" * 64)
    assert "for one weight whose hash is not known here (nomad)" in ended.err


def test_weights_in_the_cache_are_compared_with_the_hash_that_is_given(persist, original):
    sha256 = hashlib.sha256((original / "nomad.pth").read_bytes()).hexdigest()
    for hashes in (("--sha256", sha256), ("--sha256", sha256.upper()), ()):
        assert persist("weights", "fetch", "nomad", "--from", original, *hashes).code == 0
    ended = persist("weights", "fetch", "nomad", "--from", original, "--sha256", "0" * 64)
    assert f"made from a file whose SHA-256 is {sha256}, not {'0' * 64}; delete the folder" in ended.err
    assert (ended.code, ended.err.count("\n")) == (1, 1)


@pytest.mark.parametrize("change", ["missing", "unknown", "shape"])
def test_another_networks_file_is_refused_in_one_line(persist, original, change):
    tensors = published_tensors()
    if change == "missing":
        del tensors["dist_pred_net.network.0.weight"]
    elif change == "unknown":
        tensors["vision_encoder.depth.weight"] = torch.zeros(1)
    else:
        tensors["dist_pred_net.network.0.weight"] = torch.zeros(64, 512)
    torch.save(tensors, original / "nomad.pth")
    sha256 = hashlib.sha256((original / "nomad.pth").read_bytes()).hexdigest()
    ended = persist("weights", "fetch", "nomad", "--from", original, "--sha256", sha256)
    assert (ended.code, "not NoMaD's weights; " in ended.err, ended.err.count("\n")) == (1, True, 1)
