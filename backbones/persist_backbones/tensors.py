"""What model and adapters share: the order of video tokens, frames and patches folded into channels, zero weights."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float, Shaped
from torch import Tensor, nn


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


def zero_init(*modules: nn.Module) -> None:
    """Set all parameters of the modules to zero."""
    for module in modules:
        for parameter in module.parameters():
            nn.init.zeros_(parameter)


def fold_frames(
    frames: Shaped[Tensor, "batch frame channel *rest"], temporal: int, multiple: int = 1
) -> Shaped[Tensor, "batch latent_frame folded *rest"]:
    """Frames folded into channels, the first one alone in the first latent frame and repeated to fill its channels.

    It also fills the latent frames in front of that one that make their number a multiple.
    """
    missing = -frames.shape[1] % (temporal * multiple)
    first = frames[:, :1].expand(-1, missing, *frames.shape[2:])
    folded: Tensor = torch.cat([first, frames], dim=1).unflatten(1, (-1, temporal)).flatten(2, 3)
    return folded


def tokens_of(
    latents: Float[Tensor, "batch frame channel row column"],
) -> Float[Tensor, "batch token channel"]:
    """Values at each place of each frame, in the order of the transformer's video tokens."""
    tokens: Tensor = latents.flatten(3).transpose(2, 3).flatten(1, 2)
    return tokens
