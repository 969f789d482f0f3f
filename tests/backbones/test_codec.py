"""The codec: frames coded alone, pixels folded into channels, and a calm beginning."""

from __future__ import annotations

import pytest
import torch
from diffusers import AutoencoderKLCogVideoX

from persist_backbones.codec import fold_pixels, unfold_pixels
from persist_backbones.cogvideox import CogVideoX
from persist_backbones.still import apart, together
from persist_cli.world.backbone import Sampling
from tests.backbones.micro import micro, random_clips, shaken

STILL = {
    "vae": {
        "in_channels": 48,
        "out_channels": 48,
        "down_block_types": ["CogVideoXDownBlock3D"],
        "up_block_types": ["CogVideoXUpBlock3D"],
        "block_out_channels": [8],
        "layers_per_block": 1,
        "latent_channels": 4,
        "norm_num_groups": 2,
        "temporal_compression_ratio": 1,
    },
}


@pytest.fixture
def still() -> CogVideoX:
    backbone = micro(**STILL)
    shaken(backbone.codec)
    return backbone.eval()


def test_a_frame_coded_alone_does_not_depend_on_the_others(still: CogVideoX) -> None:
    clips = random_clips(2)
    whole = still.codec.encode(clips.rgb, clips.depth)
    assert whole.shape[:2] == (2, 9)
    for frame in (0, 4, 8):
        alone = still.codec.encode(clips.rgb[:, frame : frame + 1], clips.depth[:, frame : frame + 1])
        assert torch.allclose(alone[:, 0], whole[:, frame], atol=1e-5)
    assert torch.equal(still.encode(clips)[:, -1], still.encode(clips)[:, 0])


def test_the_fast_convolution_gives_what_diffusers_gives_for_videos_of_one_frame(still: CogVideoX) -> None:
    plain = AutoencoderKLCogVideoX(**{k: v for k, v in still.codec.vae.config.items() if not k.startswith("_")})
    plain.load_state_dict(still.codec.vae.state_dict())
    image = torch.randn(3, 48, 1, 8, 8, generator=torch.Generator().manual_seed(0))
    latents = plain.encode(image).latent_dist.mode()
    assert torch.allclose(still.codec.vae.encode(image).latent_dist.mode(), latents, atol=1e-4)
    assert torch.allclose(still.codec.vae.decode(latents).sample, plain.decode(latents).sample, atol=1e-4)


def test_the_fast_convolution_learns_what_diffusers_would(still: CogVideoX) -> None:
    plain = AutoencoderKLCogVideoX(**{k: v for k, v in still.codec.vae.config.items() if not k.startswith("_")})
    plain.load_state_dict(still.codec.vae.state_dict())
    image = torch.randn(1, 48, 1, 8, 8, generator=torch.Generator().manual_seed(0))
    for vae in (plain, still.codec.vae):
        vae.encode(image).latent_dist.mode().square().sum().backward()
    for (name, one), two in zip(plain.named_parameters(), still.codec.vae.parameters(), strict=True):
        if one.grad is not None:
            assert torch.allclose(one.grad, two.grad, rtol=1e-3, atol=1e-2), name


def test_folding_loses_nothing() -> None:
    videos = torch.randn(2, 3, 5, 8, 12)
    assert torch.equal(unfold_pixels(fold_pixels(videos, 4), 4), videos)
    assert torch.equal(together(apart(videos), 5), videos)
    assert fold_pixels(videos, 4).shape == (2, 48, 5, 2, 3)


@pytest.mark.parametrize("settings", [{}, STILL])
def test_a_fresh_codec_hardly_adds_noise_and_its_residual_blocks_do_nothing(settings: dict) -> None:
    codec, clips = micro(**settings).codec, random_clips(1)
    assert float(codec.posterior(codec.images(clips.rgb, clips.depth)).std.detach().mean()) < 0.1
    block = codec.vae.encoder.mid_block.resnets[0]
    hidden = torch.randn(1, block.in_channels, 1, 4, 4)
    assert torch.equal(block(hidden)[0], hidden)


def test_a_model_that_codes_frames_alone_trains_and_generates(still: CogVideoX) -> None:
    clips = random_clips(1)
    assert all(bool(still(clips, stage)["loss"].isfinite()) for stage in ("codec", "1"))
    rgb, depth = still.generate(clips, Sampling(2))
    assert rgb.shape == clips.rgb.shape
    assert depth.shape == clips.depth.shape
