"""Cameras and interactions as the transformer takes them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from persist_cli.world.backbone import Interactions
from persist_cli.world.cameras import Cameras, invert_rigid
from persist_cli.world.errors import DataError
from persist_cli.world.geometry import plucker

RAY_CHANNELS = 6


def camera_latents(
    cameras: Cameras, spatial: int, temporal: int, printed: bool, multiple: int = 1
) -> Float[Tensor, "batch latent_frame channel height width"]:
    """Plücker rays relative to each clip's first camera, at the VAE's compression.

    Mean-pooled in space, which for rays is the ray through the middle; in time frames are folded into channels
    (unpixelshuffle). As for the VAE, the first frame stands alone in the first latent frame, here repeated to fill
    its channels: 9×512×512×6 → 3×64×64×24.

    Args:
        cameras: ``[batch, frame]``, one frame and a multiple of ``temporal``.
        spatial: compression in height and width.
        temporal: compression in time.
        printed: directions as the paper prints them.
        multiple: what the number of latent frames is padded to in front, like the latents (see ``clip_shape``).
    """
    first = invert_rigid(cameras.world_from_camera[:, :1].double())
    local = Cameras(first @ cameras.world_from_camera.double(), cameras.intrinsics, cameras.height, cameras.width)
    rays = plucker(local.resized(local.height // spatial, local.width // spatial), printed)
    return fold_frames(rays.permute(0, 1, 4, 2, 3).float(), temporal, multiple)


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


def camera_tokens(
    latents: Float[Tensor, "batch frame channel height width"], patch: int, frames: int = 1
) -> Float[Tensor, "batch token folded"]:
    """The camera embedding at each video token: the mean over its patch, its latent frames folded into channels."""
    means = F.avg_pool2d(latents.flatten(0, 1), patch).unflatten(0, (len(latents), -1, frames))
    return tokens_of(means.flatten(2, 3))


def tokens_of(
    latents: Float[Tensor, "batch frame channel row column"],
) -> Float[Tensor, "batch token channel"]:
    """Values at each place of each frame, in the order of the transformer's video tokens."""
    tokens: Tensor = latents.flatten(3).transpose(2, 3).flatten(1, 2)
    return tokens


def interaction_rows(clips: Sequence[Interactions], names: Sequence[str], steps: int) -> Int[Tensor, "batch step"]:
    """Rows of the interaction embedding for each step of each clip, 0 where nothing but motion happens.

    Raises:
        DataError: for an interaction that the model has no embedding for.
    """
    rows = torch.zeros(len(clips), steps, dtype=torch.long)
    for sample, interactions in enumerate(clips):
        for step, name in enumerate(interactions[:steps]):
            if name is None:
                continue
            if name not in names:
                raise DataError(f"the model knows no interaction {name!r}; it has {', '.join(names) or 'none'}")
            rows[sample, step] = 1 + step * len(names) + list(names).index(name)
    return rows


def model_input(noisy: Tensor, image: Tensor, camera: Tensor, depth: bool) -> Tensor:
    """All channels that the transformer sees: noisy RGB, RGB image, noisy depth, depth image and camera.

    Args:
        noisy: latents ``[batch, frame, channel, height, width]`` of RGB and depth.
        image: those of the image condition.
        camera: camera latents.
        depth: false gives zeros for both parts of depth.
    """
    (color, metres), (color_image, metres_image) = noisy.chunk(2, dim=2), image.chunk(2, dim=2)
    if not depth:
        metres, metres_image = torch.zeros_like(metres), torch.zeros_like(metres_image)
    return torch.cat([color, color_image, metres, metres_image, camera.to(noisy.dtype)], dim=2)
