"""Tensor operations that model and adapters share: order of video tokens, folding, zero weights, holes of images."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import torch
import torch.nn.functional as F
from jaxtyping import Float, Shaped
from torch import Tensor, nn

from persist_cli.api.cameras import Cameras

MOST_PLACES: Final = 2**22  # points and pixels of all views that a GPU draws at once, or else one clip


def frames_per_token(config: Any) -> int:
    """Return the number of latent frames of a video token, from the configuration of diffusers' transformer."""
    return int(config.patch_size_t or 1)


def fold_patches(
    latents: Float[Tensor, "batch frame channel height width"], patch: int, frames: int
) -> Float[Tensor, "batch token folded"]:
    """Fold the patch of each video token as channel × frame × row × column, for diffusers' linear embedding."""
    folded = latents.unflatten(1, (-1, frames)).transpose(2, 3).flatten(2, 3)
    return tokens_of(F.pixel_unshuffle(folded, patch))


def unfold_patches(
    tokens: Float[Tensor, "batch token folded"], size: tuple[int, int, int], patch: int, frames: int
) -> Float[Tensor, "batch frame channel height width"]:
    """Undo ``fold_patches``.

    Args:
        tokens: patches, each folded as channel × frame × row × column.
        size: number of frames, height and width of the latents.
        patch: latent pixels along the edge of a video token.
        frames: latent frames of a video token.
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
    """Fold frames into channels; the first latent frame contains the first frame alone, repeated to fill its channels.

    The first frame also fills latent frames in front that pad their number to a multiple of ``multiple``.
    """
    missing = -frames.shape[1] % (temporal * multiple)
    first = frames[:, :1].expand(-1, missing, *frames.shape[2:])
    folded: Tensor = torch.cat([first, frames], dim=1).unflatten(1, (-1, temporal)).flatten(2, 3)
    return folded


def latent_shares(
    covered: Float[Tensor, "batch frame channel height width"], spatial: int, temporal: int
) -> Float[Tensor, "batch latent_frame folded row column"]:
    """Return the means of a mask's pixels at each latent pixel, with the frames of a latent frame as channels."""
    shares = F.avg_pool2d(covered.flatten(0, 1), spatial).unflatten(0, covered.shape[:2])
    folded: Tensor = fold_frames(shares, temporal)
    return folded


def tokens_of(
    latents: Float[Tensor, "batch frame channel row column"],
) -> Float[Tensor, "batch token channel"]:
    """Flatten the places of all frames in the order of the transformer's video tokens."""
    tokens: Tensor = latents.flatten(3).transpose(2, 3).flatten(1, 2)
    return tokens


def clips_at_once(cameras: Cameras, points: int, finer: int = 1) -> int:
    """Return how many clips are drawn at once: one on a CPU, into whose cache it fits; on a GPU as keeps it busy.

    Args:
        cameras: axes ``batch frame``.
        points: number of points that are drawn into each view of a clip.
        finer: pixels that are drawn along the edge of a pixel.
    """
    if cameras.world_from_camera.device.type == "cpu":
        return 1
    places = cameras.world_from_camera.shape[1] * (points + cameras.height * cameras.width * finer**2)
    return max(1, MOST_PLACES // places)


def clip_by_clip(
    draw: Callable[..., tuple[Tensor, ...]], *batches: Any, cameras: Cameras, points: int, finer: int
) -> tuple[Tensor, ...]:
    """Call a function with a few clips of all batches and of the cameras at a time, and join the results.

    Args:
        draw: returns tensors with a batch axis.
        batches: what has a batch axis and takes slices: tensors or tokens.
        cameras: axes ``batch frame``, the last argument of ``draw``.
        points, finer: as for ``clips_at_once``.
    """
    at_once = clips_at_once(cameras, points, finer)
    parts = [slice(first, first + at_once) for first in range(0, len(cameras), at_once)]
    results = [draw(*(batch[part] for batch in batches), cameras[part]) for part in parts]
    return tuple(torch.cat(joined) for joined in zip(*results, strict=True))


def push_pull(
    total: Float[Tensor, "image channel height width"], weight: Float[Tensor, "image 1 height width"]
) -> Float[Tensor, "image channel height width"]:
    """Fill holes: the mean of known values at each pixel, on the finest scale that has any (Gortler et al., push-pull).

    Args:
        total: sum of the known values at each pixel, 0 in holes.
        weight: how many values that sum is of, 0 in holes.
    """
    mean = total / weight.clamp_min(1e-6)
    height, width = total.shape[-2:]
    if height == width == 1:
        return mean
    pooled = (F.avg_pool2d(part, 2, ceil_mode=True) for part in (total, weight))
    # twice as large, and then cut: squeezed into an odd size, everything would move towards the first row and column
    coarse = F.interpolate(push_pull(*pooled), scale_factor=2, mode="bilinear")[..., :height, :width]
    return torch.where(weight > 0, mean, coarse)
