import shutil

import pytest
import torch

from persist_cli.errors import CheckpointError, RecipeError
from persist_cli.io.files import write_json
from persist_cli.io.hub import cached_weight
from persist_cli.plugins import make_encoder
from persist_memory.encoders.patches import EXACT, PatchesSettings, projection
from tests.support.room_views import walked


@pytest.fixture(scope="module")
def tiny_dino(tmp_path_factory):
    from transformers import Dinov2Config, Dinov2Model

    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("dinov2-tiny")
    config = Dinov2Config(
        hidden_size=24, num_hidden_layers=3, num_attention_heads=2, image_size=56, patch_size=14, mlp_ratio=2
    )
    Dinov2Model(config).save_pretrained(folder)
    return folder


def test_the_first_three_channels_of_a_patch_are_its_mean_colour():
    rgb = torch.randint(0, 256, (1, 16, 24, 3), dtype=torch.uint8)
    features = make_encoder("patches", {}).encode(rgb)
    mean = rgb.float().reshape(1, 2, 8, 3, 8, 3).mean((2, 4)) / 127.5 - 1
    torch.testing.assert_close(features[..., :3], mean, atol=1e-4, rtol=0)


def test_features_do_not_depend_on_what_else_is_encoded_to_the_bit():
    rgb = walked(5).rgb
    encoder = make_encoder("patches", {})
    assert torch.equal(encoder.encode(rgb)[3], encoder.encode(rgb[3:4])[0])


def test_weights_are_exact_binary_fractions_fixed_by_the_seed():
    weight = projection(PatchesSettings(seed=3))
    assert torch.equal(weight * EXACT, (weight * EXACT).round())
    assert torch.equal(weight, projection(PatchesSettings(seed=3)))
    assert not torch.equal(weight, projection(PatchesSettings(seed=4)))


def test_detail_channels_are_orthogonal_to_each_other_and_to_colour():
    weight = projection(PatchesSettings())
    gram = weight.T @ weight
    assert (gram - gram.diag().diag()).abs().max() < 1e-4 * gram.diag().max()


def test_features_of_real_looking_images_are_of_order_one():
    spread = make_encoder("patches", {}).encode(walked(6).rgb).std((0, 1, 2))
    assert spread.min() > 0.01
    assert spread.max() < 3


@pytest.mark.parametrize(("height", "width", "rows", "columns"), [(48, 64, 6, 8), (50, 61, 6, 8), (5, 3, 1, 1)])
def test_images_that_are_no_multiple_of_the_patch_are_resized_to_the_nearest(height, width, rows, columns):
    rgb = torch.full((2, height, width, 3), 200, dtype=torch.uint8)
    features = make_encoder("patches", {}).encode(rgb)
    assert features.shape == (2, rows, columns, 32)
    torch.testing.assert_close(features[..., 0], torch.full((2, rows, columns), 200 / 127.5 - 1), atol=1e-4, rtol=0)


def test_more_channels_than_numbers_in_a_patch_are_refused():
    with pytest.raises(RecipeError, match="13 channels are more than the 12 numbers"):
        make_encoder("patches", {"patch": 2, "channels": 13})


def test_dinov2_gives_the_patch_tokens_of_the_last_block_after_the_layer_norm(tiny_dino):
    from transformers import Dinov2Model

    encoder = make_encoder("dinov2", {"weights": str(tiny_dino)})
    rgb = walked(1).rgb[:, :42, :56]
    features = encoder.encode(rgb)
    assert features.shape == (1, 3, 4, encoder.channels)
    model = Dinov2Model.from_pretrained(tiny_dino).eval()
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    pixels = ((rgb / 255 - mean) / std).permute(0, 3, 1, 2)
    with torch.no_grad():
        expected = model(pixels).last_hidden_state[:, 1:].reshape(1, 3, 4, 24)
    torch.testing.assert_close(features, expected, atol=1e-4, rtol=1e-4)


def test_dinov2_takes_any_size_and_a_block_in_the_middle(tiny_dino):
    settings = {"weights": str(tiny_dino), "size": 100, "layer": 2}
    features = make_encoder("dinov2", settings).encode(walked(3).rgb)
    assert features.shape == (3, 5, 7, 24)  # 75 × 100 pixels in patches of 14
    last = make_encoder("dinov2", settings | {"layer": None}).encode(walked(3).rgb)
    assert not torch.allclose(features, last)


@pytest.mark.parametrize("layer", [1, 2, None])
def test_dinov2_gives_what_transformers_has_behind_a_block_and_computes_no_further(tiny_dino, layer, capfd):
    from transformers import Dinov2Model

    encoder, rgb = make_encoder("dinov2", {"weights": str(tiny_dino), "layer": layer}), walked(1).rgb[:, :42, :56]
    features = encoder.encode(rgb)
    assert capfd.readouterr().err == ""  # not even a bar
    model = Dinov2Model.from_pretrained(tiny_dino).eval()
    with torch.no_grad():
        states = model(encoder._pixels(rgb, 3, 4), output_hidden_states=True).hidden_states
        expected = model.layernorm(states[-1 if layer is None else layer])[:, 1:].reshape(1, 3, 4, 24)
    assert torch.equal(features, expected)
    assert len(encoder._model.encoder.layer) == (layer or len(states) - 1)


def test_dinov2_in_bf16_gives_nearly_the_same_features_in_float32(tiny_dino):
    exact, half = (
        make_encoder("dinov2", {"weights": str(tiny_dino), "precision": each}) for each in ("float32", "bf16")
    )
    rgb = walked(2).rgb
    likeness = torch.nn.functional.cosine_similarity(exact.encode(rgb), half.encode(rgb), dim=-1)
    assert half.encode(rgb).dtype == torch.float32
    assert 0.99 < likeness.min() < 1


def test_dinov2_frames_do_not_depend_on_their_neighbours_to_the_bit(tiny_dino):
    encoder, rgb = make_encoder("dinov2", {"weights": str(tiny_dino)}), walked(3).rgb
    assert torch.equal(encoder.encode(rgb)[1], encoder.encode(rgb[1:2])[0])


@pytest.mark.parametrize("broken", ["absent", "no_weights", "truncated", "pickle"])
def test_dinov2_without_usable_weights_says_in_one_line_what_to_do(tiny_dino, tmp_path, monkeypatch, broken):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    folder = tmp_path / "dino"
    if broken != "absent":
        folder.mkdir()
        (folder / "config.json").write_bytes((tiny_dino / "config.json").read_bytes())
    if broken == "truncated":
        (folder / "model.safetensors").write_bytes((tiny_dino / "model.safetensors").read_bytes()[:500])
    if broken == "pickle":
        torch.save({}, folder / "pytorch_model.bin")
    with pytest.raises(CheckpointError) as caught:
        make_encoder("dinov2", {"weights": str(folder)}).encode(walked(1).rgb)
    message = str(caught.value)
    assert "\n" not in message
    assert str(folder) in message
    assert "patches" in message


def test_a_block_that_dinov2_does_not_have_is_refused(tiny_dino):
    with pytest.raises(CheckpointError, match="has 3 blocks, no block 9"):
        _ = make_encoder("dinov2", {"weights": str(tiny_dino), "layer": 9}).channels


def test_dinov2_takes_fetched_weights_by_their_name(tiny_dino, tmp_path, monkeypatch):
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path))
    shutil.copytree(tiny_dino, tmp_path / "weights" / "dinov2-small")
    rgb = walked(1).rgb
    with pytest.raises(CheckpointError, match="'dinov2-small': not here: persist weights fetch dinov2-small"):
        make_encoder("dinov2", {}).encode(rgb)
    write_json(tmp_path / "weights" / "dinov2-small" / "weight.json", {"name": "dinov2-small"})
    expected = make_encoder("dinov2", {"weights": str(tiny_dino)}).encode(rgb)
    assert torch.equal(make_encoder("dinov2", {}).encode(rgb), expected)
    with pytest.raises(CheckpointError, match="persist weights fetch dinov2-s-derived"):  # none stands in for another
        make_encoder("dinov2", {"weights": "dinov2-s-derived"}).encode(rgb)


def test_a_hub_id_is_opened_from_the_hubs_cache_or_refused_without_waiting(tmp_path, tiny_dino, monkeypatch):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(CheckpointError, match="not in the hub's cache, and the hub: HF_HUB_OFFLINE is set"):
        _ = make_encoder("dinov2", {"weights": "someone/dinov2-tiny"}).channels
    obstacle = "http://127.0.0.1:9 does not answer"
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", "http://127.0.0.1:9")
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with pytest.raises(CheckpointError, match=obstacle):
        _ = make_encoder("dinov2", {"weights": "someone/dinov2-tiny"}).channels


@pytest.mark.skipif(cached_weight("dinov2-s-derived") is None, reason="persist weights fetch dinov2-s-derived")
def test_the_derived_dinov2_gives_block_8_and_sees_the_same_wall_from_elsewhere():
    encoder = make_encoder("dinov2", {"weights": "dinov2-s-derived", "layer": 8})
    rgb = walked(1).rgb[:, :42, :56].repeat(2, 1, 1, 1)
    rgb[1] = rgb[0].roll(14, dims=1)  # by one patch
    one, two = torch.nn.functional.normalize(encoder.encode(rgb), dim=-1)
    assert one.shape == (3, 4, 384)
    same, other = (one[:, :3] * two[:, 1:]).sum(-1).mean(), (one[:, :3] * two[:, :3]).sum(-1).mean()
    assert same > other
