"""Rotary positions of CogVideoX 1.0 at the size the model works at."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
from diffusers.models.embeddings import get_3d_rotary_pos_embed
from torch import Tensor


def rotary_positions(config: Any, frames: int, device: torch.device) -> tuple[Tensor, Tensor] | None:
    """Cosines and sines for every video token, ``None`` for models with absolute positions only.

    Args:
        config: of diffusers' transformer; its sample size is the one it works at, so no crop is needed.
        frames: latent frames.
        device: where they are wanted.
    """
    if not config.use_rotary_positional_embeddings:
        return None
    rows, columns = config.sample_height // config.patch_size, config.sample_width // config.patch_size
    return _positions(config.attention_head_dim, rows, columns, frames, str(device))


@lru_cache(maxsize=4)
def _positions(channels: int, rows: int, columns: int, frames: int, device: str) -> tuple[Tensor, Tensor]:
    cosines, sines = get_3d_rotary_pos_embed(
        embed_dim=channels,
        crops_coords=((0, 0), (rows, columns)),
        grid_size=(rows, columns),
        temporal_size=frames,
        device=torch.device(device),
    )
    return cosines, sines
