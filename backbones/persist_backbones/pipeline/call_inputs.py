"""Conversion of a pipeline's inputs, in the types of diffusers' users, to a batch of clips."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from persist_cli.api.backbone import Clips, Interactions
from persist_cli.api.cameras import Cameras
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import DataError

BRIGHTEST = 1.01  # of floating point images, which are in [0, 1] but for rounding


def make_clips(
    images: Tensor,
    depth: Any,
    cameras: Cameras | Sequence[Cameras],
    interactions: Sequence[Interactions] | None,
    tokens: MemoryTokens | Sequence[MemoryTokens] | None,
    check_frames: Callable[[int], None],
) -> Clips:
    """Make the batch of clips that begin with these images.

    Args:
        images: uint8 ``[batch, height, width, 3]``.
        depth: metres ``[height, width]``, a batch or a list of them; ``None`` if it is unknown.
        cameras: cameras of every frame of a clip, the image's first; a batch or a list of them.
        interactions: one sequence a sample; ``None`` for no interactions.
        tokens: tokens from ``Memory.read``, of one sample, a batch or a list of samples.
        check_frames: raises ``PersistError`` when clips of so many frames cannot be made.

    Raises:
        PersistError: one line when their sizes or numbers do not fit each other or the model.
    """
    batch, height, width = images.shape[:3]
    path = batch_of_cameras(cameras)
    metres = torch.zeros(batch, height, width) if depth is None else batch_of_depth(depth)
    frames = path.world_from_camera.shape[1]
    check_frames(frames)
    if (path.height, path.width) != (height, width) or metres.shape[1:] != (height, width):
        raise DataError(
            f"an image of {height}x{width} pixels, depth of {metres.shape[1]}x{metres.shape[2]} and cameras of "
            f"{path.height}x{path.width}; they must be one size"
        )
    memory = None if tokens is None else batch_of_tokens(tokens)
    steps = interactions or [(None,) * (frames - 1)] * batch
    counts = {"depth": len(metres), "cameras": len(path), "interactions": len(steps)}
    counts |= {} if memory is None else {"memory_tokens": len(memory.mask)}
    for name, count in counts.items():
        if count != batch:
            raise DataError(f"{name} of {count} samples, but {batch} images")
    wrong = next((len(one) for one in steps if len(one) != frames - 1), None)
    if wrong is not None:
        raise DataError(f"interactions of {wrong} steps; a clip of {frames} frames has {frames - 1}")
    return Clips(images[:, None], metres[:, None], path, steps, memory, seeds=range(batch))


def batch_of_images(images: Any) -> Tensor:
    """Convert a PIL image, an array, a tensor, or a list of them, to uint8 ``[batch, height, width, 3]``.

    Integers must be uint8 ``[height, width, 3]``; floating point values are diffusers' ``pt``, ``[3, height, width]``
    in [0, 1]; both may have a batch axis.

    Raises:
        DataError: one line with the shape and type that were given.
    """
    if isinstance(images, (list, tuple)):
        return torch.cat([batch_of_images(image) for image in images])
    if not isinstance(images, Tensor):
        pixels = images.convert("RGB") if hasattr(images, "convert") else images
        images = torch.from_numpy(np.array(pixels))
    _check_images(images)
    if images.is_floating_point():
        if images.amax() > BRIGHTEST:
            raise DataError(f"a floating point image of values up to {float(images.amax()):g}; give them in [0, 1]")
        images = (images.movedim(-3, -1) * 255).round().clamp(0, 255).to(torch.uint8)
    batch: Tensor = images.reshape(-1, *images.shape[-3:])
    return batch


def _check_images(images: Tensor) -> None:
    floating = images.is_floating_point()
    channels_at = -3 if floating else -1
    if images.ndim in (3, 4) and images.shape[channels_at] == 3 and (floating or images.dtype == torch.uint8):
        return
    raise DataError(
        f"an image of shape {list(images.shape)} and {images.dtype}; give a PIL image, uint8 [height, width, 3], or "
        "floating point [3, height, width] in [0, 1]"
    )


def batch_of_depth(depth: Any) -> Tensor:
    """Convert depth of one sample, a batch or a list to metres ``[batch, height, width]``, 0 where none is known.

    Raises:
        DataError: when it is of whole numbers, which are millimetres as a rule.
    """
    if isinstance(depth, (list, tuple)):
        return torch.cat([batch_of_depth(sample) for sample in depth])
    metres = torch.as_tensor(depth)
    if not metres.is_floating_point():
        raise DataError(f"depth of {metres.dtype}; give floating point metres, as depth / 1000 of millimetres")
    metres = torch.where(metres.isfinite() & (metres > 0), metres, 0).float()
    return metres.reshape(-1, *metres.shape[-2:])


def batch_of_cameras(cameras: Cameras | Sequence[Cameras]) -> Cameras:
    """Convert cameras of one sample, a batch or a list to cameras ``[batch, frame]``."""
    if not isinstance(cameras, Cameras):
        return Cameras.concatenate([batch_of_cameras(sample) for sample in cameras])
    poses, matrices = cameras.world_from_camera, cameras.intrinsics
    frames = poses.shape[-3]
    return Cameras(
        poses.reshape(-1, frames, 4, 4), matrices.reshape(-1, frames, 3, 3), cameras.height, cameras.width
    )  # fmt: skip


def batch_of_tokens(tokens: MemoryTokens | Sequence[MemoryTokens]) -> MemoryTokens:
    """Convert tokens of one sample, a batch or a list to tokens with a batch axis."""
    if not isinstance(tokens, MemoryTokens):
        return MemoryTokens.stack(list(tokens))
    return tokens if tokens.mask.ndim == 2 else MemoryTokens.stack([tokens])
