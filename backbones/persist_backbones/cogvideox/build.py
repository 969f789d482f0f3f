"""The parts of a CogVideoX world model: how it begins, whether they fit, how they are widened, what is ours."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from diffusers import AutoencoderKLCogVideoX, CogVideoXDDIMScheduler
from diffusers.models.autoencoders.autoencoder_kl_cogvideox import CogVideoXResnetBlock3D

from persist_backbones.adapters.base import VideoShape
from persist_backbones.cogvideox.codec import Codec, check_vae, spatial_compression
from persist_backbones.cogvideox.config import PRESETS, CogVideoXSettings
from persist_backbones.cogvideox.diffusion import check_prediction
from persist_backbones.cogvideox.inputs import RAY_CHANNELS, clip_shape, fit_positions
from persist_backbones.cogvideox.model import WorldTransformer
from persist_backbones.cogvideox.pretrained import (
    DiffusersParts,
    check_name,
    folder_here,
    load_parts,
    make_part,
    on_meta_device,
    pretrained_folder,
    published_preset,
)
from persist_backbones.tensors import frames_per_token
from persist_cli.errors import CheckpointError

INITIAL_LOG_VARIANCE = -6.0  # of fresh latents: noise that does not drown what has not been learnt yet


def starting_parts(settings: CogVideoXSettings) -> DiffusersParts:
    """The parts that a model of these settings begins with.

    A plan asks no network: of weights that are not here it takes the sizes that their name tells, else the preset's.
    """
    if settings.pretrained is None:
        return make_parts(settings)
    if not on_meta_device():
        return load_parts(pretrained_folder(settings.pretrained))
    folder = folder_here(settings.pretrained)
    if folder is not None:
        return load_parts(folder)
    check_name(settings.pretrained)
    preset: Any = published_preset(settings.pretrained) or settings.preset
    return make_parts(dataclasses.replace(settings, preset=preset))


def make_parts(settings: CogVideoXSettings) -> DiffusersParts:
    """Freshly initialised parts of the settings' preset and sizes."""
    preset = PRESETS[settings.preset]
    shown = {"sample_height": settings.height, "sample_width": settings.width}
    vae = make_part("vae", preset["vae"] | shown | settings.vae)
    initialize(vae)
    spatial = spatial_compression(vae)
    size = {
        "sample_height": settings.height // spatial,
        "sample_width": settings.width // spatial,
        "sample_frames": settings.frames,
    }
    transformer = make_part("transformer", preset["transformer"] | size | settings.transformer)
    prediction = {"prediction_type": settings.prediction} if settings.prediction else {}
    return DiffusersParts(transformer, vae, CogVideoXDDIMScheduler(**(preset["scheduler"] | prediction)))


def initialize(vae: AutoencoderKLCogVideoX) -> None:
    """Begin a fresh VAE with residual blocks that are the identity and latents with little noise."""
    with torch.no_grad():
        vae.encoder.conv_out.conv.bias[vae.config.latent_channels :] = INITIAL_LOG_VARIANCE
        for module in vae.modules():
            if isinstance(module, CogVideoXResnetBlock3D):
                module.conv2.conv.weight.zero_()
                module.conv2.conv.bias.zero_()


def check_fit(parts: DiffusersParts, settings: CogVideoXSettings) -> None:
    """Raise ``CheckpointError`` when the parts do not work together at the settings' size."""
    check_vae(parts.vae)
    check_prediction(parts.scheduler, settings.prediction)
    check_frames(int(parts.vae.config.temporal_compression_ratio), settings)
    config, vae = parts.transformer.config, parts.vae.config
    unit = spatial_compression(parts.vae) * config.patch_size
    if settings.height % unit or settings.width % unit:
        raise CheckpointError(f"image size {settings.height}x{settings.width} must be a multiple of {unit}")
    if config.in_channels not in (vae.latent_channels, 2 * vae.latent_channels):
        raise CheckpointError(
            f"a transformer of {config.in_channels} channels does not fit a VAE of {vae.latent_channels}"
        )
    if config.ofs_embed_dim and config.ofs_embed_dim != config.time_embed_dim:
        raise CheckpointError(
            f"a transformer whose ofs_embed_dim {config.ofs_embed_dim} is not its time_embed_dim "
            f"{config.time_embed_dim} cannot add one to the other"
        )
    tables = config.use_learned_positional_embeddings or not config.use_rotary_positional_embeddings
    if config.patch_size_t is not None and tables:
        raise CheckpointError("patch_size_t needs rotary positions alone, as CogVideoX 1.5 has them")


def check_frames(temporal: int, settings: CogVideoXSettings) -> None:
    """Raise ``CheckpointError`` when the codec, of this compression in time, cannot code the settings' frames."""
    # diffusers' decoder doubles time in halves and tells a first frame from an odd number of latent frames
    step = 2 * temporal if temporal > 1 else 1
    rule, window = f"{step}n + 1, " if step > 1 else "", (settings.codec_window or (1,))[0]
    if settings.frames < 2 or (settings.frames - 1) % step:
        raise CheckpointError(f"frames must be {rule}at least 2, not {settings.frames}")
    if window < 1 or (window - 1) % step:
        raise CheckpointError(f"codec_window's frames must be {rule}at least 1, not {window}")


def widen(parts: DiffusersParts, settings: CogVideoXSettings) -> WorldTransformer:
    """The transformer with zero-initialised inputs and outputs for RGB-D, cameras and interactions."""
    latents = parts.vae.config.latent_channels
    camera = RAY_CHANNELS * int(parts.vae.config.temporal_compression_ratio)
    slots = (settings.frames - 1) * len(settings.interactions)
    shape = clip_shape(parts.transformer, parts.vae, settings)
    fit_positions(parts.transformer, (shape.padded_frames, shape.height, shape.width))
    seen = camera * shape.token_frames
    return WorldTransformer(parts.transformer, 4 * latents + camera, 2 * latents, slots, seen)


def video_shape(transformer: WorldTransformer, codec: Codec) -> VideoShape:
    """What an adapter must know of the model."""
    config = transformer.base.config
    return VideoShape(
        channels=config.num_attention_heads * config.attention_head_dim,
        camera_channels=transformer.camera_channels,
        time_channels=config.time_embed_dim,
        layers=config.num_layers,
        patch=config.patch_size,
        spatial=codec.spatial,
        temporal=codec.temporal,
        inputs=transformer.in_channels,
        outputs=transformer.out_channels,
        token_frames=frames_per_token(config),
    )
