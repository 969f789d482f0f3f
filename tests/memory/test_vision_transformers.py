"""CLIP's patch features from its published form, and the control of a network that was never trained."""

import pytest
import torch
from transformers import CLIPConfig, CLIPModel, CLIPVisionConfig, CLIPVisionModel

from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.errors import CheckpointError
from persist_cli.io.files import read_json
from persist_memory.encoders.clip import CLIP_MEAN, CLIP_STD, Clip, ClipSettings
from persist_memory.encoders.random_vit import RandomVit, RandomVitSettings
from tests.support.micro_runs import SHORT, losses
from tests.support.room_views import room_walk

VISION = {
    "hidden_size": 24, "num_hidden_layers": 3, "num_attention_heads": 2, "image_size": 56, "patch_size": 14,
    "intermediate_size": 48,
}  # fmt: skip

TEXT = {
    "hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2, "vocab_size": 50000,
}  # fmt: skip


@pytest.fixture(scope="module")
def tiny_clip(tmp_path_factory):
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("clip-tiny")
    CLIPModel(CLIPConfig(vision_config=VISION, text_config=TEXT, projection_dim=8)).save_pretrained(folder)
    return folder


def test_clip_gives_the_patch_tokens_of_the_vision_model_in_a_checkpoint_of_both(tiny_clip, capfd):
    rgb = room_walk(1).rgb[:, :42, :56]
    encoder = Clip(ClipSettings(weights=str(tiny_clip)))
    features = encoder.encode(rgb)
    assert (features.shape, encoder.channels) == ((1, 3, 4, 24), 24)
    assert capfd.readouterr().err == ""  # the weights of the text model are no concern of the user's
    pixels = ((rgb / 255 - torch.tensor(CLIP_MEAN)) / torch.tensor(CLIP_STD)).permute(0, 3, 1, 2)
    vision = CLIPModel.from_pretrained(tiny_clip).eval().vision_model
    with torch.no_grad():
        states = vision(pixels, interpolate_pos_encoding=True).last_hidden_state
    torch.testing.assert_close(features, states[:, 1:].reshape(1, 3, 4, 24), atol=1e-4, rtol=1e-4)


def test_clip_stops_at_a_block_in_the_middle_and_no_frame_depends_on_another(tiny_clip):
    rgb = room_walk(2).rgb
    middle = Clip(ClipSettings(weights=str(tiny_clip), layer=2))
    assert not torch.allclose(middle.encode(rgb), Clip(ClipSettings(weights=str(tiny_clip))).encode(rgb))
    assert torch.equal(middle.encode(rgb)[1], middle.encode(rgb[1:])[0])


def test_the_papers_form_trains_on_features_of_clip(persist, tiny_clip, walks, stage1, tmp_path):
    weights = f"memory.encoder_settings.weights={tiny_clip}"
    command = ("finetune", "houses-64-paper-clip", "--data", walks, "--out", tmp_path, f"base={stage1}", weights)
    few = ("data.clip_frames=[9]", "training.steps=2", "training.cooldown=0", "training.precision=no")
    trained = persist(*command, *SHORT, *few, "training.frozen_precision=no")
    assert trained.code == 0, trained.err
    memory = read_json(find_checkpoint(tmp_path).adapter_folder("voxel") / "memory.json")
    assert (memory["encoder"], memory["encoder_settings"]["weights"]) == ("clip", str(tiny_clip))
    first, last = losses(tmp_path)
    assert first != last


def test_weights_that_lack_a_part_are_refused_and_not_made_up(tiny_clip, tmp_path):
    CLIPVisionModel(CLIPVisionConfig(**(VISION | {"num_hidden_layers": 2}))).save_pretrained(tmp_path)
    CLIPVisionConfig(**VISION).save_pretrained(tmp_path)
    with pytest.raises(CheckpointError, match="they lack 16 tensors"):
        Clip(ClipSettings(weights=str(tmp_path))).encode(room_walk(1).rgb)


def test_missing_clip_weights_name_the_command_that_brings_them():
    with pytest.raises(CheckpointError, match="persist weights fetch clip-of-nobody"):
        Clip(ClipSettings(weights="clip-of-nobody")).encode(room_walk(1).rgb)
    assert Clip(ClipSettings()).channels_by_name == 1024


def test_a_seed_gives_a_random_network_its_weights_and_leaves_the_random_state_alone():
    rgb = room_walk(1).rgb
    torch.manual_seed(1)
    one, other = (RandomVit(RandomVitSettings(seed=seed, layer=1, size=28)).encode(rgb) for seed in (0, 1))
    drawn = torch.rand(1)
    assert one.shape == (1, 2, 2, 384)
    assert torch.equal(one, RandomVit(RandomVitSettings(layer=1, size=28)).encode(rgb))
    assert not torch.allclose(one, other)
    torch.manual_seed(1)
    assert torch.equal(drawn, torch.rand(1))
