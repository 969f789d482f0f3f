"""DreamSim on random weights, against transformers' network."""

import pytest
import torch

from persist_cli.metrics import METRICS, dreamsim
from tests.support.predictions import cache_random, prediction, random_frames, setup, still_camera

DREAMSIM = METRICS["dreamsim"]


def test_missing_weights_are_an_obstacle_that_names_the_folder_option(tmp_path, monkeypatch):
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path))
    assert DREAMSIM.obstacle(setup()) == ("weights dreamsim are not here: persist weights fetch dreamsim --from DIR")


@pytest.fixture
def narrow(tmp_path, monkeypatch):
    """Random weights of a narrow network."""
    monkeypatch.setattr(dreamsim, "WIDTH", 24)
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path))
    cache_random(tmp_path, "dreamsim", dreamsim.tensor_shapes())


def test_only_a_copy_has_no_distance_and_a_frame_counts_alone_as_among_others(narrow):
    (rgb, depth), (other, _) = random_frames(0, frames=3), random_frames(1, frames=3)
    truth = still_camera(rgb, depth)
    assert DREAMSIM.measure(prediction(rgb, depth, truth)).tolist() == pytest.approx([0.0] * 3, abs=1e-12)
    figures = DREAMSIM.measure(prediction(other, depth, truth))
    assert figures.min() > 0
    alone = DREAMSIM.measure(prediction(other[1:2], depth[1:2], still_camera(rgb[1:2], depth[1:2])))
    assert torch.equal(alone, figures[1:2])


def test_the_class_token_equals_the_one_of_transformers(narrow):
    from transformers import ViTConfig, ViTModel

    from persist_cli.metrics.networks import network_weights

    weights = network_weights("dreamsim", dreamsim.tensor_shapes())
    sizes = {"hidden_size": 24, "intermediate_size": 96, "num_hidden_layers": 12, "num_attention_heads": 12}
    network = ViTModel(ViTConfig(layer_norm_eps=1e-6, **sizes), add_pooling_layer=False).eval()
    network.load_state_dict(rename_tensors(weights))
    rgb, _ = random_frames(0, frames=1, size=224)
    mean, std = (torch.tensor(values)[:, None, None] for values in (dreamsim.MEAN, dreamsim.STD))
    with torch.no_grad():
        states = network((rgb.permute(0, 3, 1, 2) / 255 - mean) / std, output_hidden_states=True).hidden_states
    torch.testing.assert_close(dreamsim.class_token(weights, rgb), states[-1][:, 0], atol=1e-4, rtol=1e-4)


def rename_tensors(weights: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Give the tensors the names that transformers uses."""
    names = {
        "cls_token": "embeddings.cls_token", "pos_embed": "embeddings.position_embeddings", "norm1": "layernorm_before",
        "norm2": "layernorm_after", "blocks": "layers", "attn.proj": "attention.o_proj", "norm.": "layernorm.",
        "patch_embed.proj": "embeddings.patch_embeddings.projection",
    }  # fmt: skip
    tensors = {}
    for name, tensor in weights.items():
        new = name
        for old, replacement in names.items():
            new = new.replace(old, replacement)
        if "attn.qkv" in name:
            for letter, chunk in zip("qkv", tensor.chunk(3), strict=True):
                tensors[new.replace("attn.qkv", f"attention.{letter}_proj")] = chunk
        else:
            tensors[new] = tensor
    return tensors
