"""Video tokens and the patches of latents that they stand for: squares of one frame, in CogVideoX 1.5 of several."""

from __future__ import annotations

from typing import Any

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from persist_backbones.conditioning import tokens_of


def frames_per_token(config: Any) -> int:
    """Latent frames that a video token stands for, by the configuration of diffusers' transformer."""
    return int(config.patch_size_t or 1)


def fold_patches(
    latents: Float[Tensor, "batch frame channel height width"], patch: int, frames: int
) -> Float[Tensor, "batch token folded"]:
    """The patch of each video token as channel × frame × row × column, as diffusers' linear embedding has it."""
    folded = latents.unflatten(1, (-1, frames)).transpose(2, 3).flatten(2, 3)
    return tokens_of(F.pixel_unshuffle(folded, patch))


def unfold_patches(
    tokens: Float[Tensor, "batch token folded"], size: tuple[int, int, int], patch: int, frames: int
) -> Float[Tensor, "batch frame channel height width"]:
    """The latents that ``fold_patches`` folded.

    Args:
        tokens: of each patch channel × frame × row × column.
        size: frames, height and width of the latents.
        patch: latent pixels along the edge of a token.
        frames: latent frames of a token.
    """
    grid = tokens.unflatten(1, (size[0] // frames, size[1] // patch, size[2] // patch)).movedim(-1, 2)
    latents: Tensor = F.pixel_shuffle(grid, patch).unflatten(2, (-1, frames)).transpose(2, 3).flatten(1, 2)
    return latents
