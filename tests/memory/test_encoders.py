import shutil

import pytest
import torch
from torch.nn.modules.module import register_module_forward_hook

from persist_cli.errors import CheckpointError, RecipeError
from persist_cli.io.files import write_json
from persist_cli.io.hub import cached_weight
from persist_cli.plugins import make_encoder
from persist_memory.encoders.patches import EXACT, PatchesSettings, projection
from tests.support.room_views import room_walk


@pytest.fixture(scope="module")
def tiny_dinov2(tmp_path_factory):
    from transformers import Dinov2Config, Dinov2Model

    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("dinov2-tiny")
    config = Dinov2Config(
        hidden_size=24, num_hidden_layers=3, num_attention_heads=2, image_size=56, patch_size=14, mlp_ratio=2
    )
    Dinov2Model(config).save_pretrained(folder)
    return folder


def normalized(rgb):
    """Images in the range that DINOv2 was trained on, channels first."""
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    return ((rgb / 255 - mean) / std).permute(0, 3, 1, 2)


def test_the_first_three_channels_of_a_patch_are_its_mean_colour():
    rgb = torch.randint(0, 256, (1, 16, 24, 3), dtype=torch.uint8)
    features = make_encoder("patches", {}).encode(rgb)
    mean = rgb.float().reshape(1, 2, 8, 3, 8, 3).mean((2, 4)) / 127.5 - 1
    torch.testing.assert_close(features[..., :3], mean, atol=1e-4, rtol=0)


def test_no_bit_of_a_frames_features_depends_on_the_other_frames():
    rgb = room_walk(5).rgb
    encoder = make_encoder("patches", {})
    assert torch.equal(encoder.encode(rgb)[3], encoder.encode(rgb[3:4])[0])


def test_weights_are_exact_binary_fractions_fixed_by_the_seed():
    weight = projection(PatchesSettings(seed=3))
    assert torch.equal(weight * EXACT, (weight * EXACT).round())
    assert torch.equal(weight, projection(PatchesSettings(seed=3)))
    assert not torch.equal(weight, projection(PatchesSettings(seed=4)))


@pytest.mark.parametrize("name", ["patches", "random-vit"])
@pytest.mark.parametrize("seed", [-1, 2**32])
def test_a_seed_out_of_its_range_is_refused(name, seed):
    with pytest.raises(RecipeError, match=f"seed must be a whole number of at least 0 and below {2**32}, not {seed}"):
        make_encoder(name, {"seed": seed})


def test_detail_channels_are_orthogonal_to_each_other_and_to_colour():
    weight = projection(PatchesSettings())
    gram = weight.T @ weight
    assert (gram - gram.diag().diag()).abs().max() < 1e-4 * gram.diag().max()


def test_features_of_textured_images_are_of_order_one():
    spread = make_encoder("patches", {}).encode(room_walk(6).rgb).std((0, 1, 2))
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


def test_a_large_patch_takes_no_more_than_its_channels_and_what_a_machine_cannot_hold_is_refused():
    large = make_encoder("patches", {"patch": 400, "channels": 3})  # all its cosines would take 205 GB
    assert large.encode(torch.zeros(1, 400, 800, 3, dtype=torch.uint8)).shape == (1, 1, 2, 3)
    with pytest.raises(RecipeError, match="take a matrix of more than 67,108,864 numbers"):
        make_encoder("patches", {"patch": 4000, "channels": 4000})


def test_dinov2_gives_the_patch_tokens_of_the_last_block_after_the_layer_norm(tiny_dinov2):
    from transformers import Dinov2Model

    encoder = make_encoder("dinov2", {"weights": str(tiny_dinov2)})
    rgb = room_walk(1).rgb[:, :42, :56]
    features = encoder.encode(rgb)
    assert features.shape == (1, 3, 4, encoder.channels)
    model = Dinov2Model.from_pretrained(tiny_dinov2).eval()
    with torch.no_grad():
        expected = model(normalized(rgb)).last_hidden_state[:, 1:].reshape(1, 3, 4, 24)
    torch.testing.assert_close(features, expected, atol=1e-4, rtol=1e-4)


def test_dinov2_takes_any_size_and_a_block_in_the_middle(tiny_dinov2):
    settings = {"weights": str(tiny_dinov2), "size": 100, "layer": 2}
    features = make_encoder("dinov2", settings).encode(room_walk(3).rgb)
    assert features.shape == (3, 5, 7, 24)  # 75 × 100 pixels in patches of 14
    last = make_encoder("dinov2", settings | {"layer": None}).encode(room_walk(3).rgb)
    assert not torch.allclose(features, last)


@pytest.mark.parametrize("layer", [1, 2, None])
def test_dinov2_gives_the_output_of_the_chosen_block_and_computes_no_further_block(tiny_dinov2, layer, capfd):
    from transformers import Dinov2Model
    from transformers.models.dinov2.modeling_dinov2 import Dinov2Layer

    encoder, rgb = make_encoder("dinov2", {"weights": str(tiny_dinov2), "layer": layer}), room_walk(1).rgb[:, :42, :56]
    computed: list[Dinov2Layer] = []
    hook = register_module_forward_hook(
        lambda module, *_: computed.append(module) if isinstance(module, Dinov2Layer) else None
    )
    features = encoder.encode(rgb)
    hook.remove()
    assert capfd.readouterr().err == ""  # no progress bar either
    model = Dinov2Model.from_pretrained(tiny_dinov2).eval()
    with torch.no_grad():
        states = model(normalized(rgb), output_hidden_states=True).hidden_states
        expected = model.layernorm(states[-1 if layer is None else layer])[:, 1:].reshape(1, 3, 4, 24)
    assert torch.equal(features, expected)
    assert len(computed) == (layer or len(states) - 1)


def test_dinov2_in_bf16_gives_nearly_the_same_features_in_float32(tiny_dinov2):
    exact, half = (
        make_encoder("dinov2", {"weights": str(tiny_dinov2), "precision": name}) for name in ("float32", "bf16")
    )
    rgb = room_walk(2).rgb
    similarity = torch.nn.functional.cosine_similarity(exact.encode(rgb), half.encode(rgb), dim=-1)
    assert half.encode(rgb).dtype == torch.float32
    assert 0.99 < similarity.min() < 1


def test_no_bit_of_a_frames_dinov2_features_depends_on_its_neighbours(tiny_dinov2):
    encoder, rgb = make_encoder("dinov2", {"weights": str(tiny_dinov2)}), room_walk(3).rgb
    assert torch.equal(encoder.encode(rgb)[1], encoder.encode(rgb[1:2])[0])


@pytest.mark.parametrize("broken", ["absent", "no_weights", "truncated", "pickle"])
def test_unusable_dinov2_weights_are_an_error_of_one_line_that_says_what_to_do(
    tiny_dinov2, tmp_path, monkeypatch, broken
):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    folder = tmp_path / "dino"
    if broken != "absent":
        folder.mkdir()
        (folder / "config.json").write_bytes((tiny_dinov2 / "config.json").read_bytes())
    if broken == "truncated":
        (folder / "model.safetensors").write_bytes((tiny_dinov2 / "model.safetensors").read_bytes()[:500])
    if broken == "pickle":
        torch.save({}, folder / "pytorch_model.bin")
    with pytest.raises(CheckpointError) as caught:
        make_encoder("dinov2", {"weights": str(folder)}).encode(room_walk(1).rgb)
    message = str(caught.value)
    assert "\n" not in message
    assert str(folder) in message
    assert "patches" in message


def test_a_block_number_beyond_the_dinov2_weights_is_refused(tiny_dinov2):
    with pytest.raises(CheckpointError, match="has 3 blocks, no block 9"):
        _ = make_encoder("dinov2", {"weights": str(tiny_dinov2), "layer": 9}).channels


def test_dinov2_opens_fetched_weights_by_their_name(tiny_dinov2, tmp_path, monkeypatch):
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path))
    shutil.copytree(tiny_dinov2, tmp_path / "weights" / "dinov2-small")
    rgb = room_walk(1).rgb
    with pytest.raises(CheckpointError, match="'dinov2-small': not here: persist weights fetch dinov2-small"):
        make_encoder("dinov2", {}).encode(rgb)
    write_json(tmp_path / "weights" / "dinov2-small" / "weight.json", {"name": "dinov2-small"})
    expected = make_encoder("dinov2", {"weights": str(tiny_dinov2)}).encode(rgb)
    assert torch.equal(make_encoder("dinov2", {}).encode(rgb), expected)
    with pytest.raises(CheckpointError, match="persist weights fetch dinov2-s-derived"):  # none stands in for another
        make_encoder("dinov2", {"weights": "dinov2-s-derived"}).encode(rgb)


def test_a_hub_id_outside_the_cache_is_refused_at_once_when_the_hub_does_not_answer(tmp_path, tiny_dinov2, monkeypatch):
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
def test_features_of_the_derived_dinov2_move_with_the_image():
    encoder = make_encoder("dinov2", {"weights": "dinov2-s-derived", "layer": 8})
    rgb = room_walk(1).rgb[:, :42, :56].repeat(2, 1, 1, 1)
    rgb[1] = rgb[0].roll(14, dims=1)  # by one patch
    features, rolled = torch.nn.functional.normalize(encoder.encode(rgb), dim=-1)
    assert features.shape == (3, 4, 384)
    same_place = (features[:, :3] * rolled[:, 1:]).sum(-1).mean()
    same_pixels = (features[:, :3] * rolled[:, :3]).sum(-1).mean()
    assert same_place > same_pixels
