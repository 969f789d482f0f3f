"""CogVideoX's transformer, widened for depth, image condition, cameras, interactions and memory.

The published weights stay in their own module, unchanged and loadable by diffusers. The new modules are beside it and
zero-initialised: a second patch embedding added to the first, more output channels, and an embedding added to the time
embedding. Because exact zeros are added, the widened model equals the original to the bit.
"""

from __future__ import annotations

import contextlib
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from persist_backbones.adapters.base import MemoryCondition, NoiseLevel, VideoShape
from persist_backbones.cogvideox.config import CogVideoXSettings
from persist_backbones.cogvideox.inputs import RAY_CHANNELS, ClipShape, camera_tokens, model_input
from persist_backbones.diffusers_models import AutoencoderKLCogVideoX, CogVideoXTransformer3DModel
from persist_backbones.noise_levels import LevelEmbedding
from persist_backbones.tensors import fold_patches, frames_per_token, tokens_of, unfold_patches, zero_init
from persist_cli.api.cpu_attention import products_for_training

OFFSET = 2.0  # the value of ``ofs`` in the training of CogVideoX 1.5 image-to-video
NO_MEMORY = MemoryCondition()


@dataclass(frozen=True)
class Conditions:
    """The transformer's inputs besides the noisy latents.

    Args:
        text: the prompt's embedding.
        timestep: timestep of each sample.
        level: the noise levels of the timesteps, by which the memory corrects the prediction.
        interactions: rows of the interaction embedding, 0 for none.
        camera: camera embedding at each video token, for the queries of memory blocks.
        rotary: cosines and sines, for models with rotary positions.
        memory: an adapter with the tokens that it prepared, or no memory.
        image_noise: noise level of each sample's given frame, ``None`` for 0.
    """

    text: Float[Tensor, "batch word channel"]
    timestep: Int[Tensor, " batch"]
    level: NoiseLevel
    interactions: Int[Tensor, "batch step"]
    camera: Float[Tensor, "batch token camera"]
    rotary: tuple[Tensor, Tensor] | None = None
    memory: MemoryCondition = NO_MEMORY
    image_noise: Float[Tensor, " batch"] | None = None


class WorldTransformer(nn.Module):
    """The widened transformer, which predicts velocities or clean latents of RGB and depth (see ``diffusion``).

    Args:
        base: diffusers' transformer.
        latent_channels: number of latent channels of RGB, and as many of depth.
        temporal: factor of the codec's compression in time.
        shape: shape of a clip.
        settings: the interactions, and whether noise levels of the given frame are embedded.
    """

    def __init__(
        self,
        base: CogVideoXTransformer3DModel,
        latent_channels: int,
        temporal: int,
        shape: ClipShape,
        settings: CogVideoXSettings,
    ) -> None:
        super().__init__()
        config = base.config
        inner = config.num_attention_heads * config.attention_head_dim
        patch, frames, camera = config.patch_size, frames_per_token(config), RAY_CHANNELS * temporal
        # noisy RGB, RGB image, noisy depth, depth image and camera in; RGB and depth out
        in_channels, out_channels = 4 * latent_channels + camera, 2 * latent_channels
        new = in_channels - config.in_channels
        self.base = base
        self.extra_in: nn.Module
        if config.patch_size_t is None:
            self.extra_in = nn.Conv2d(new, inner, patch, stride=patch, bias=False)
        else:
            self.extra_in = nn.Linear(new * frames * patch**2, inner, bias=False)
        self.extra_out = nn.Linear(inner, frames * patch**2 * (out_channels - config.out_channels))
        interactions = (settings.frames - 1) * len(settings.interactions)
        self.interactions = nn.Embedding(1 + interactions, config.time_embed_dim, padding_idx=0)
        self.camera_channels = camera * shape.token_frames  # at a video token
        self.in_channels, self.out_channels = in_channels, out_channels
        self.image_level = LevelEmbedding(config.time_embed_dim) if settings.image_noise else None
        zero_init(self.extra_in, self.extra_out, self.interactions)

    def video_shape(self, spatial: int, temporal: int) -> VideoShape:
        """Return the sizes of the model, with the codec's compression in space and time, for an adapter."""
        config = self.base.config
        return VideoShape(
            channels=config.num_attention_heads * config.attention_head_dim,
            camera_channels=self.camera_channels,
            time_channels=config.time_embed_dim,
            layers=config.num_layers,
            patch=config.patch_size,
            spatial=spatial,
            temporal=temporal,
            inputs=self.in_channels,
            outputs=self.out_channels,
            token_frames=frames_per_token(config),
        )

    def predict(
        self, noisy: Tensor, image: Tensor, conditions: Conditions, shape: ClipShape, depth: bool
    ) -> Float[Tensor, "batch frame out height width"]:
        """Predict from noisy latents and those of the image condition; the conditions' cameras are latents, too."""
        latents = model_input(noisy, image, conditions.camera, depth)
        camera = camera_tokens(conditions.camera, shape.patch, shape.token_frames)
        predicted: Tensor = self(latents, replace(conditions, camera=camera))
        return predicted

    def forward(
        self, latents: Float[Tensor, "batch frame channel height width"], conditions: Conditions
    ) -> Float[Tensor, "batch frame out height width"]:
        """Predict RGB and depth latents, concatenated on channels."""
        time = conditions.memory.time(self.embed_time(conditions, latents.dtype))
        text, video = self.embed_patches(latents, conditions.text.to(latents.dtype))
        video = conditions.memory.begin(video)
        for layer, block in enumerate(self.base.transformer_blocks):
            video = conditions.memory.before(layer, video)
            video, text = block(
                hidden_states=video, encoder_hidden_states=text, temb=time, image_rotary_emb=conditions.rotary
            )
            video = conditions.memory.after(layer, video, conditions.camera, time)
        video = self.base.norm_out(self.base.norm_final(video), temb=time)
        outputs = (self.base.proj_out(video), self.extra_out(video))
        predicted = torch.cat([self.unpatchify(tokens, latents) for tokens in outputs], dim=2)
        return conditions.memory.correct(predicted, latents, time, conditions.level)

    def kernel_for_training(self, inputs: Tensor) -> AbstractContextManager[None]:
        """Within the block, attention is as ``products_for_training`` says; blocks that are computed again are not."""
        return contextlib.nullcontext() if self.base.gradient_checkpointing else products_for_training(inputs)

    def embed_time(self, conditions: Conditions, dtype: torch.dtype) -> Float[Tensor, "batch time"]:
        """Return the sum of the embeddings of time, ``ofs`` (CogVideoX 1.5 image-to-video), interactions and noise."""
        time: Tensor = self.base.time_embedding(self.base.time_proj(conditions.timestep).to(dtype))
        if self.base.ofs_embedding is not None:
            offset = torch.full((1,), OFFSET, device=time.device)
            time = time + self.base.ofs_embedding(self.base.ofs_proj(offset).to(dtype))
        interactions: Tensor = self.interactions(conditions.interactions).sum(dim=1)
        time = time + interactions.to(time.dtype)
        if self.image_level is None:
            return time
        level = time.new_zeros(len(time)) if conditions.image_noise is None else conditions.image_noise
        embedded: Tensor = self.image_level(level)
        return time + embedded.to(time.dtype)

    def embed_patches(self, latents: Tensor, text: Tensor) -> tuple[Tensor, Tensor]:
        """Embed text and video: diffusers' patch embedding of the published channels plus that of the new ones."""
        published = self.base.config.in_channels
        tokens: Tensor = self.base.patch_embed(text, latents[:, :, :published])
        words = text.shape[1]
        video = tokens[:, words:] + self.embed_new(latents[:, :, published:])
        return tokens[:, :words], self.base.embedding_dropout(video)

    def embed_new(self, latents: Tensor) -> Float[Tensor, "batch token channel"]:
        """Return the patch embedding of the channels that the published model does not have."""
        config = self.base.config
        if config.patch_size_t is not None:
            embedded: Tensor = self.extra_in(fold_patches(latents, config.patch_size, config.patch_size_t))
            return embedded
        return tokens_of(self.extra_in(latents.flatten(0, 1)).unflatten(0, latents.shape[:2]))

    def unpatchify(self, tokens: Tensor, like: Tensor) -> Tensor:
        """Turn patches back into frames of the size of ``like``."""
        config = self.base.config
        size = (like.shape[1], like.shape[3], like.shape[4])
        return unfold_patches(tokens, size, config.patch_size, frames_per_token(config))


def widen(
    base: CogVideoXTransformer3DModel, vae: AutoencoderKLCogVideoX, settings: CogVideoXSettings, shape: ClipShape
) -> WorldTransformer:
    """Add zero-initialised inputs and outputs for RGB-D, cameras and interactions to diffusers' transformer."""
    temporal = int(vae.config.temporal_compression_ratio)
    return WorldTransformer(base, vae.config.latent_channels, temporal, shape, settings)
