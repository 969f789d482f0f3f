"""Sizes of a clip as latents and as video tokens, and the padding between the two.

A model whose tokens stand for several latent frames (CogVideoX 1.5) takes a multiple of them. What is missing is put
in front: the first latent frame again, the cameras of the first frame again, and the image condition at the very
first place. So CogVideoX 1.5 was trained and so diffusers samples it, and drops these frames before decoding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from persist_backbones.codec import spatial_compression
from persist_backbones.patches import frames_per_token
from persist_backbones.weights.presets import CogVideoXSettings


@dataclass(frozen=True)
class ClipShape:
    """How a clip is divided.

    Args:
        frames: latent frames of a clip, without padding.
        height: latent pixels.
        width: latent pixels.
        patch: latent pixels along the edge of a video token.
        token_frames: latent frames that a video token stands for.
    """

    frames: int
    height: int
    width: int
    patch: int
    token_frames: int

    @property
    def padded_frames(self) -> int:
        """Latent frames that the model takes."""
        return self.frames + -self.frames % self.token_frames

    @property
    def tokens(self) -> tuple[int, int, int]:
        """Frames, rows and columns of video tokens."""
        return self.padded_frames // self.token_frames, self.height // self.patch, self.width // self.patch

    def pad(
        self, latents: Float[Tensor, "batch frame channel height width"]
    ) -> Float[Tensor, "batch padded_frame channel height width"]:
        """Latents with the first frame repeated in front."""
        missing = self.padded_frames - self.frames
        return torch.cat([latents[:, :1].expand(-1, missing, -1, -1, -1), latents], dim=1) if missing else latents

    def drop_padding(
        self, latents: Float[Tensor, "batch padded_frame channel height width"]
    ) -> Float[Tensor, "batch frame channel height width"]:
        """The latents without what ``pad`` put in front."""
        return latents[:, self.padded_frames - self.frames :]

    def image_condition(
        self, first: Float[Tensor, "batch 1 channel height width"]
    ) -> Float[Tensor, "batch padded_frame channel height width"]:
        """The latents of the first frame alone at the very first place, zeros at all others."""
        zeros = first.new_zeros(first.shape[0], self.padded_frames - 1, *first.shape[2:])
        return torch.cat([first, zeros], dim=1)


def clip_shape(transformer: Any, vae: Any, settings: CogVideoXSettings) -> ClipShape:
    """The shape of the settings' clips for diffusers' transformer and VAE."""
    spatial, config = spatial_compression(vae), transformer.config
    return ClipShape(
        frames=(settings.frames - 1) // int(vae.config.temporal_compression_ratio) + 1,
        height=settings.height // spatial,
        width=settings.width // spatial,
        patch=config.patch_size,
        token_frames=frames_per_token(config),
    )
