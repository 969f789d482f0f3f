"""The widened model: diffusers' own weights to the bit, and parts and sizes that are refused."""

import pytest
import torch
from diffusers import AutoencoderKLCogVideoX, CogVideoXDDIMScheduler, CogVideoXTransformer3DModel

from persist_backbones.cogvideox.parts import load_parts
from persist_cli.errors import CheckpointError
from persist_cli.plugins import make_backbone
from tests.support.micro_runs import MICRO, SIZE


@pytest.fixture
def plain_folder(tmp_path):
    """A CogVideoX image-to-video directory as diffusers alone writes it."""
    torch.manual_seed(0)
    transformer = CogVideoXTransformer3DModel(
        **MICRO["transformer"], sample_height=8, sample_width=8, sample_frames=9, max_text_seq_length=4
    )
    transformer.save_pretrained(tmp_path / "transformer")
    blocks = {"down_block_types": ("CogVideoXDownBlock3D",) * 3, "up_block_types": ("CogVideoXUpBlock3D",) * 3}
    AutoencoderKLCogVideoX(**MICRO["vae"], **blocks).save_pretrained(tmp_path / "vae")
    CogVideoXDDIMScheduler(prediction_type="v_prediction").save_pretrained(tmp_path / "scheduler")
    return tmp_path


def test_a_plain_diffusers_directory_gives_the_widened_model(plain_folder):
    model = make_backbone("cogvideox", {"pretrained": str(plain_folder), "height": SIZE, "width": SIZE, "prompt": None})
    stored = load_parts(plain_folder).transformer.state_dict()
    loaded = model.transformer.base.state_dict()
    assert all(torch.equal(loaded[name], value) for name, value in stored.items())
    assert not any(value.any() for name, value in model.transformer.named_parameters() if "base." not in name)


def test_diffusers_loads_the_base_that_we_save(plain_folder, tmp_path):
    model = make_backbone("cogvideox", {"pretrained": str(plain_folder), "height": SIZE, "width": SIZE, "prompt": None})
    model.save_base(tmp_path / "ours")
    reloaded = CogVideoXTransformer3DModel.from_pretrained(tmp_path / "ours", subfolder="transformer")
    assert all(
        torch.equal(value, model.transformer.base.state_dict()[name]) for name, value in reloaded.state_dict().items()
    )


@pytest.mark.parametrize("part", ["transformer", "vae", "scheduler"])
def test_a_missing_or_truncated_part_is_refused(plain_folder, part):
    for file in (plain_folder / part).iterdir():
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(CheckpointError, match=rf"{part}: its configuration cannot be read") as error:
        load_parts(plain_folder)
    assert "\n" not in str(error.value)
    for file in (plain_folder / part).iterdir():
        file.unlink()
    (plain_folder / part).rmdir()
    with pytest.raises(CheckpointError, match=f"no {part}/ folder"):
        load_parts(plain_folder)


@pytest.mark.parametrize(
    ("change", "cause"),
    [({"height": 30}, "multiple of 8"), ({"frames": 13}, r"8n \+ 1"), ({"frames": 1}, r"8n \+ 1, at least 2"),
     ({"codec_window": (5, 8, 8)}, "codec_window"), ({"transformer": {"in_channels": 6}}, "does not fit a VAE"),
     ({"codec_window": (9, 30, 32)}, r"codec_window \[9, 30, 32\]: height and width must be multiples of"),
     ({"vae": {"latent_channels": 4}, "transformer": {"in_channels": 8}}, "give transformer.out_channels=4"),
     ({"transformer": {"attention_head_dim": 30, "use_rotary_positional_embeddings": True}}, "need a multiple of 16"),
     ({"transformer": {"activation_fn": "foo"}}, "diffusers cannot make a transformer of these settings"),
     ({"transformer": {"patch_size_t": 2}}, "patch_size_t needs rotary positions alone"),
     ({"transformer": {"ofs_embed_dim": 8}}, "ofs_embed_dim 8 is not its time_embed_dim 256")],
)  # fmt: skip
def test_settings_of_impossible_sizes_are_refused(change, cause):
    with pytest.raises(CheckpointError, match=cause):
        make_backbone("cogvideox", {"transformer": {"num_layers": 1}} | change)


def test_the_tiny_preset_has_ten_million_parameters():
    with torch.device("meta"):
        model = make_backbone("cogvideox", {})
    parameters = model.transformer.base.parameters()
    assert sum(parameter.numel() for parameter in parameters) == pytest.approx(9.88e6, rel=0.01)
