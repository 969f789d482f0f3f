"""Rotary positions of CogVideoX 1.0 and 1.5 at the size the model works at."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
from diffusers.models.embeddings import get_3d_rotary_pos_embed
from torch import Tensor

Region = tuple[tuple[int, int], tuple[int, int]]  # row and column of the first place, and one past those of the last


def rotary_positions(config: Any, grid: tuple[int, int, int], device: torch.device) -> tuple[Tensor, Tensor] | None:
    """Cosines and sines for every video token, ``None`` for models with absolute positions only.

    CogVideoX 1.0 fits a clip's grid into the middle of the one it was trained on; 1.5 counts its rows and columns.

    Args:
        config: of diffusers' transformer; its sample size is the one it was trained on.
        grid: frames, rows and columns of video tokens.
        device: where they are wanted.
    """
    if not config.use_rotary_positional_embeddings:
        return None
    if config.patch_size_t is not None:
        return _kept(_counted, config.attention_head_dim, grid, str(device))
    trained = (config.sample_height // config.patch_size, config.sample_width // config.patch_size)
    return _kept(_fitted, config.attention_head_dim, grid, middle_region(grid[1:], trained), str(device))


def _kept(positions: Any, *given: Any) -> tuple[Tensor, Tensor]:
    """What the cached function gives; not from nor into its cache while tensors have no values, to count memory."""
    real = type(torch.empty(0)) is torch.Tensor
    found: tuple[Tensor, Tensor] = positions(*given) if real else positions.__wrapped__(*given)
    return found


def middle_region(shape: tuple[int, int], trained: tuple[int, int]) -> Region:
    """The largest region with the aspect of ``shape`` in the middle of a trained grid, both in rows and columns."""
    rows, columns = trained
    if shape[0] / shape[1] > rows / columns:
        columns = round(trained[0] / shape[0] * shape[1])
    else:
        rows = round(trained[1] / shape[1] * shape[0])
    top, left = round((trained[0] - rows) / 2), round((trained[1] - columns) / 2)
    return (top, left), (top + rows, left + columns)


@lru_cache(maxsize=4)
def _fitted(channels: int, grid: tuple[int, int, int], region: Region, device: str) -> tuple[Tensor, Tensor]:
    cosines, sines = get_3d_rotary_pos_embed(
        embed_dim=channels,
        crops_coords=region,
        grid_size=grid[1:],
        temporal_size=grid[0],
        device=torch.device(device),
    )
    return cosines, sines


@lru_cache(maxsize=4)
def _counted(channels: int, grid: tuple[int, int, int], device: str) -> tuple[Tensor, Tensor]:
    cosines, sines = get_3d_rotary_pos_embed(
        embed_dim=channels,
        crops_coords=None,
        grid_size=grid[1:],
        temporal_size=grid[0],
        grid_type="slice",
        max_size=grid[1:],  # what is sliced away does not change the rest
        device=torch.device(device),
    )
    return cosines, sines
