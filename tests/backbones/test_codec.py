"""The codec: framewise coding, pixels folded into channels, fresh weights, and VAEs that are refused."""

from __future__ import annotations

import dataclasses
import hashlib
from typing import Any

import pytest
import torch
from diffusers import AutoencoderKLCogVideoX

from persist_backbones.cogvideox.codec import (
    batch_to_frames,
    decode_depth,
    fold_pixels,
    frames_to_batch,
    to_uint8,
    unfold_pixels,
)
from persist_backbones.cogvideox.cogvideox import CogVideoX
from persist_backbones.cogvideox.diffusion import sample_generators
from persist_cli.api.backbone import Sampling
from persist_cli.doctor.tracing import fake_tensors
from persist_cli.errors import CheckpointError
from persist_cli.plugins import make_backbone
from tests.support.micro_model import micro, random_clips, shaken

FRAMEWISE = {
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
def framewise() -> CogVideoX:
    backbone = micro(**FRAMEWISE)
    shaken(backbone.codec)
    return backbone.eval()


def test_a_frame_coded_alone_does_not_depend_on_the_others(framewise: CogVideoX) -> None:
    clips = random_clips(2)
    whole = framewise.codec.encode(clips.rgb, clips.depth)
    assert whole.shape[:2] == (2, 9)
    for frame in (0, 4, 8):
        alone = framewise.codec.encode(clips.rgb[:, frame : frame + 1], clips.depth[:, frame : frame + 1])
        assert torch.allclose(alone[:, 0], whole[:, frame], atol=1e-5)
    latents = framewise.encode(clips)
    assert torch.equal(latents.video, whole)
    assert torch.equal(latents.image, whole[:, :1])


def test_the_fast_convolution_equals_that_of_diffusers_for_videos_of_one_frame(framewise: CogVideoX) -> None:
    plain = AutoencoderKLCogVideoX(**{k: v for k, v in framewise.codec.vae.config.items() if not k.startswith("_")})
    plain.load_state_dict(framewise.codec.vae.state_dict())
    image = torch.randn(3, 48, 1, 8, 8, generator=torch.Generator().manual_seed(0))
    latents = plain.encode(image).latent_dist.mode()
    assert torch.allclose(framewise.codec.vae.encode(image).latent_dist.mode(), latents, atol=1e-4)
    assert torch.allclose(framewise.codec.vae.decode(latents).sample, plain.decode(latents).sample, atol=1e-4)


def test_the_fast_convolution_continues_a_video_as_diffusers_does(framewise: CogVideoX) -> None:
    plain = AutoencoderKLCogVideoX(**{k: v for k, v in framewise.codec.vae.config.items() if not k.startswith("_")})
    plain.load_state_dict(framewise.codec.vae.state_dict())
    for vae in (plain, framewise.codec.vae):
        vae.num_latent_frames_batch_size = vae.num_sample_frames_batch_size = 1
    video = torch.randn(2, 48, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    latents = plain.encode(video).latent_dist.mode()
    assert torch.allclose(framewise.codec.vae.encode(video).latent_dist.mode(), latents, atol=1e-4)
    assert torch.allclose(framewise.codec.vae.decode(latents).sample, plain.decode(latents).sample, atol=1e-4)


def test_the_fast_convolution_has_the_gradients_of_diffusers(framewise: CogVideoX) -> None:
    plain = AutoencoderKLCogVideoX(**{k: v for k, v in framewise.codec.vae.config.items() if not k.startswith("_")})
    plain.load_state_dict(framewise.codec.vae.state_dict())
    image = torch.randn(1, 48, 1, 8, 8, generator=torch.Generator().manual_seed(0))
    for vae in (plain, framewise.codec.vae):
        vae.encode(image).latent_dist.mode().square().sum().backward()
    for (name, slow), fast in zip(plain.named_parameters(), framewise.codec.vae.parameters(), strict=True):
        if slow.grad is not None:
            assert torch.allclose(slow.grad, fast.grad, rtol=1e-3, atol=1e-2), name


@torch.no_grad()
def test_batches_too_large_for_diffusers_are_coded_in_parts() -> None:
    codec = micro().codec
    few, many = (random_clips(count, size=(9, 32, 32)) for count in (1, 3))
    whole = codec.encode(many.rgb, many.depth)
    codec.samples_at_once = lambda *_: 2  # type: ignore[method-assign]
    assert torch.allclose(codec.encode(many.rgb, many.depth), whole, atol=1e-5)
    assert to_uint8(codec.decode_images(whole)[0]).shape == many.rgb.shape
    assert codec.encode(few.rgb, few.depth).shape == whole[:1].shape


@torch.no_grad()
def test_clips_of_the_papers_size_are_decoded_in_batches_of_any_number() -> None:
    sizes = {"height": 512, "width": 512, "frames": 9}
    with torch.device("meta"):
        codec = make_backbone("cogvideox", {"preset": "5b-i2v"} | sizes).codec
    assert codec.samples_at_once(128, (512, 512)) == 2
    assert codec.samples_at_once(256, (512, 512)) == 1
    with fake_tensors():
        codec.to_empty(device="cpu")
        colors, depth = codec.decode_images(torch.zeros(4, 3, 32, 64, 64))
    assert (colors.shape, depth.shape) == ((4, 3, 9, 512, 512), (4, 9, 512, 512))


def test_unfolding_undoes_folding() -> None:
    videos = torch.randn(2, 3, 5, 8, 12)
    assert torch.equal(unfold_pixels(fold_pixels(videos, 4), 4), videos)
    assert torch.equal(batch_to_frames(frames_to_batch(videos), 5), videos)
    assert fold_pixels(videos, 4).shape == (2, 48, 5, 2, 3)


@pytest.mark.parametrize("settings", [{}, FRAMEWISE])
def test_a_fresh_codec_adds_little_noise_and_its_residual_blocks_are_the_identity(settings: dict) -> None:
    codec, clips = micro(**settings).codec, random_clips(1)
    assert float(codec.posterior(codec.images(clips.rgb, clips.depth)).std.detach().mean()) < 0.1
    block = codec.vae.encoder.mid_block.resnets[0]
    hidden = torch.randn(1, block.in_channels, 1, 4, 4)
    assert torch.equal(block(hidden)[0], hidden)


def test_a_model_with_a_framewise_codec_trains_and_generates(framewise: CogVideoX) -> None:
    clips = random_clips(1)
    assert all(bool(framewise(clips, stage)["loss"].isfinite()) for stage in ("codec", "1"))
    rgb, depth = framewise.generate(clips, Sampling(2))
    assert rgb.shape == clips.rgb.shape
    assert depth.shape == clips.depth.shape


@pytest.mark.parametrize("settings", [{}, FRAMEWISE], ids=["video", "frames alone"])
def test_training_on_encoded_latents_equals_training_on_their_images(settings: dict) -> None:
    backbone, clips = micro(**settings), random_clips(2)
    shaken(backbone)
    cached = dataclasses.replace(clips, latents=backbone.encode(clips), rgb=clips.rgb[:, :0], depth=clips.depth[:, :0])
    losses, cached_losses = backbone(clips, "1"), backbone(cached, "1")
    assert all(torch.equal(value, cached_losses[name]) for name, value in losses.items())


def test_a_fingerprint_depends_on_the_weights_and_their_scale_only(framewise: CogVideoX) -> None:
    first = framewise.encoding()
    shaken(framewise.transformer)
    assert framewise.encoding() == first
    shaken(framewise.codec)
    second = framewise.encoding()
    framewise.finish_stage("codec", [random_clips(1)])
    third = framewise.encoding()
    framewise.to(torch.bfloat16)
    assert len({first, second, third, framewise.encoding()}) == 4


def test_unchanged_weights_are_hashed_once(framewise: CogVideoX, monkeypatch: pytest.MonkeyPatch) -> None:
    first = framewise.encoding()
    monkeypatch.setattr(hashlib, "sha256", None)
    assert framewise.encoding() == first


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ({"in_channels": 12}, "12 input and 3 output channels"),
        ({"in_channels": 24, "out_channels": 24}, "24 input and 24 output channels; both must be 3 p²"),
        ({"in_channels": 2, "out_channels": 2}, "2 input and 2 output channels"),
        ({"block_out_channels": [8, 8, 8, 8]}, "4 block_out_channels, 3 down and 3 up blocks"),
        ({"temporal_compression_ratio": 3}, "cannot compress time by 3, only by 1, 2, 4"),
        ({"temporal_compression_ratio": 8}, "cannot compress time by 8, only by 1, 2, 4"),
        ({"norm_num_groups": 3}, "diffusers cannot make a vae of these settings"),
        ({"chanels": 3}, "diffusers cannot make a vae of these settings"),
    ],
)
def test_a_vae_that_cannot_work_is_refused(change: dict, cause: str) -> None:
    vae = {"block_out_channels": [8, 8, 8], "norm_num_groups": 4, "latent_channels": 4}
    with pytest.raises(CheckpointError, match=cause) as error:
        micro(vae=vae | change)
    assert "\n" not in str(error.value)


def test_the_scale_is_that_of_weights_that_were_replaced_in_place(framewise: CogVideoX) -> None:
    clips = random_clips(1)
    with torch.no_grad():
        framewise.codec.encode(clips.rgb, clips.depth)  # keeps sums of the weights
    for parameter in framewise.codec.parameters():
        parameter.data.mul_(1.5)
    framewise.codec.take_scale([(clips.rgb, clips.depth)])
    fresh = micro(**FRAMEWISE).codec
    fresh.load_state_dict(framewise.codec.state_dict())
    fresh.take_scale([(clips.rgb, clips.depth)])
    assert framewise.codec.vae.config.scaling_factor == fresh.vae.config.scaling_factor


@pytest.mark.parametrize("frames", [2, 3, 4, 9])
def test_a_framewise_codec_takes_clips_of_any_number_of_frames(frames: int) -> None:
    framewise = micro(**FRAMEWISE, frames=frames, codec_window=[frames - 1, 32, 32])
    assert framewise.frames_per_clip == frames
    with pytest.raises(CheckpointError, match="frames must be at least 2, not 1"):
        micro(**FRAMEWISE, frames=1)
    with pytest.raises(CheckpointError, match="codec_window's frames must be at least 1, not 0"):
        micro(**FRAMEWISE, codec_window=[0, 32, 32])


def numbered_clips(batch: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Clips of 3 frames, 6 rows and 5 columns, and depth of the number of each pixel."""
    depth = torch.arange(90.0).reshape(1, 3, 6, 5).repeat(batch, 1, 1, 1)
    return depth[..., None].expand(-1, -1, -1, -1, 3).to(torch.uint8), depth


def test_windows_of_training_are_anywhere_in_a_clip_and_of_depth_where_those_of_colour_are() -> None:
    rgb, depth = micro().codec.windows(*numbered_clips(120), (2, 4, 4), sample_generators(range(120)))
    assert torch.equal(rgb.float(), depth[..., None].expand_as(rgb))
    corners = {30 * frame + 5 * row + column for frame in (0, 1) for row in (0, 1, 2) for column in (0, 1)}
    assert {*depth[:, 0, 0, 0].int().tolist()} == corners


def test_the_window_of_a_sample_depends_on_its_seed_and_not_on_its_batch() -> None:
    codec, seeds = micro().codec, range(4)
    _, together = codec.windows(*numbered_clips(4), (1, 4, 4), sample_generators(seeds))
    alone = [codec.windows(*numbered_clips(1), (1, 4, 4), sample_generators([seed]))[1] for seed in seeds]
    assert torch.equal(together, torch.cat(alone))


def test_each_window_of_training_is_drawn_with_the_seed_of_its_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    model, clips, seeds = micro(codec_window=[1, 16, 16]), random_clips(2), []
    windows = model.codec.windows

    def recorded(*arguments: Any) -> Any:
        seeds.extend(generator.initial_seed() for generator in arguments[-1])
        return windows(*arguments)

    monkeypatch.setattr(model.codec, "windows", recorded)
    model(clips, "codec")
    assert seeds == clips.seeds


def test_the_codec_learns_depth_too() -> None:
    model, clips = micro(), random_clips(1)
    flat = dataclasses.replace(clips, depth=torch.full_like(clips.depth, 3.0))
    one, other = (model(seen, "codec") for seen in (clips, flat))
    assert one["psnr"] == other["psnr"]  # which is of the colours
    assert (one["loss"] - other["loss"]).abs() > 1e-3


def test_decoded_depth_is_that_of_the_mean_of_the_three_channels(monkeypatch: pytest.MonkeyPatch) -> None:
    codec = micro().codec
    channels = torch.tensor([-0.3, 0.1, 0.5]).view(1, 3, 1, 1, 1)
    monkeypatch.setattr(codec, "images_of", lambda latents: channels.expand(len(latents), 3, 1, 2, 2))
    _, depth = codec.decode_images(torch.zeros(1, 1, 2 * codec.channels, 1, 1))
    torch.testing.assert_close(depth, decode_depth(torch.full((1, 1, 2, 2), 0.1)))
