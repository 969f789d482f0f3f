"""CogVideoX's transformer widened for depth, image condition, cameras, interactions and memory.

The published weights stay in their own module, untouched and loadable by diffusers; what is new stands beside them,
zero-initialised: a second patch embedding added to the first, more output channels, an embedding added to the time
embedding. Sums with exact zeros keep the widened model equal to the original to the bit.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from diffusers import AutoencoderKLCogVideoX, CogVideoXTransformer3DModel
from jaxtyping import Float, Int
from torch import Tensor, nn

from persist_backbones.adapters.base import MemoryCondition, VideoShape
from persist_backbones.cogvideox.config import CogVideoXSettings
from persist_backbones.cogvideox.inputs import RAY_CHANNELS, ClipShape
from persist_backbones.tensors import fold_patches, frames_per_token, tokens_of, unfold_patches

OFFSET = 2.0  # what CogVideoX 1.5 image-to-video was trained with as ``ofs``


NO_MEMORY = MemoryCondition()


@dataclass(frozen=True)
class Conditions:
    """What the transformer sees beside the noisy latents.

    Args:
        text: prompt embedding.
        timestep: noise levels.
        interactions: rows of the interaction embedding, 0 for none.
        camera: camera embedding at each video token, for the queries of memory blocks.
        rotary: cosines and sines, for models with rotary positions.
        memory: an adapter with the tokens that it prepared, or no memory.
    """

    text: Float[Tensor, "batch word channel"]
    timestep: Int[Tensor, " batch"]
    interactions: Int[Tensor, "batch step"]
    camera: Float[Tensor, "batch token camera"]
    rotary: tuple[Tensor, Tensor] | None = None
    memory: MemoryCondition = NO_MEMORY


class WorldTransformer(nn.Module):
    """Predicts of RGB and depth latents what the objective asks for (see ``diffusion``).

    Args:
        base: diffusers' transformer.
        latent_channels: of RGB, and of depth.
        temporal: compression of the codec in time.
        shape: of a clip.
        interactions: rows of the interaction embedding without the first, which is none.
    """

    def __init__(
        self,
        base: CogVideoXTransformer3DModel,
        latent_channels: int,
        temporal: int,
        shape: ClipShape,
        interactions: int,
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
        self.interactions = nn.Embedding(1 + interactions, config.time_embed_dim, padding_idx=0)
        self.camera_channels = camera * shape.token_frames  # at a video token
        self.in_channels, self.out_channels = in_channels, out_channels
        for module in (self.extra_in, self.extra_out, self.interactions):
            for parameter in module.parameters():
                nn.init.zeros_(parameter)

    def video_shape(self, spatial: int, temporal: int) -> VideoShape:
        """What an adapter must know of the model, with the compression of its codec in space and time."""
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

    def forward(
        self, latents: Float[Tensor, "batch frame channel height width"], given: Conditions
    ) -> Float[Tensor, "batch frame out height width"]:
        """Predictions of RGB and depth latents, concatenated on channels."""
        time = self.embed_time(given, latents.dtype)
        text, video = self.embed_patches(latents, given.text.to(latents.dtype))
        for layer, block in enumerate(self.base.transformer_blocks):
            video = given.memory.before(layer, video)
            video, text = block(
                hidden_states=video, encoder_hidden_states=text, temb=time, image_rotary_emb=given.rotary
            )
            video = given.memory.after(layer, video, given.camera, time)
        video = self.base.norm_out(self.base.norm_final(video), temb=time)
        outputs = (self.base.proj_out(video), self.extra_out(video))
        predicted = torch.cat([self.unpatchify(tokens, latents) for tokens in outputs], dim=2)
        return given.memory.correct(predicted, latents, time)

    def embed_time(self, given: Conditions, dtype: torch.dtype) -> Float[Tensor, "batch time"]:
        """The time embedding, for CogVideoX 1.5 image-to-video with ``ofs``, and the interactions of the clip added."""
        time: Tensor = self.base.time_embedding(self.base.time_proj(given.timestep).to(dtype))
        if self.base.ofs_embedding is not None:
            offset = torch.full((1,), OFFSET, device=time.device)
            time = time + self.base.ofs_embedding(self.base.ofs_proj(offset).to(dtype))
        done: Tensor = self.interactions(given.interactions).sum(dim=1)
        return time + done.to(time.dtype)

    def embed_patches(self, latents: Tensor, text: Tensor) -> tuple[Tensor, Tensor]:
        """Text and video tokens: diffusers' patch embedding of its own channels plus that of the new ones."""
        known = self.base.config.in_channels
        tokens: Tensor = self.base.patch_embed(text, latents[:, :, :known])
        words = text.shape[1]
        video = tokens[:, words:] + self.embed_new(latents[:, :, known:])
        return tokens[:, :words], self.base.embedding_dropout(video)

    def embed_new(self, latents: Tensor) -> Float[Tensor, "batch token channel"]:
        """The patch embedding of the channels that the published model does not know."""
        config = self.base.config
        if config.patch_size_t is not None:
            embedded: Tensor = self.extra_in(fold_patches(latents, config.patch_size, config.patch_size_t))
            return embedded
        return tokens_of(self.extra_in(latents.flatten(0, 1)).unflatten(0, latents.shape[:2]))

    def unpatchify(self, tokens: Tensor, like: Tensor) -> Tensor:
        """Tokens of patches back to frames of the latents' size."""
        config = self.base.config
        size = (like.shape[1], like.shape[3], like.shape[4])
        return unfold_patches(tokens, size, config.patch_size, frames_per_token(config))


def widen(
    base: CogVideoXTransformer3DModel, vae: AutoencoderKLCogVideoX, settings: CogVideoXSettings, shape: ClipShape
) -> WorldTransformer:
    """diffusers' transformer with zero-initialised inputs and outputs for RGB-D, cameras and interactions."""
    interactions = (settings.frames - 1) * len(settings.interactions)
    temporal = int(vae.config.temporal_compression_ratio)
    return WorldTransformer(base, vae.config.latent_channels, temporal, shape, interactions)
