"""What the given frame shows in the views of the frames to come: its pixels, moved by depth and cameras.

A video model of few layers hardly learns to move a picture by a camera's motion; told what the given frame shows where,
it has to invent only what that frame does not show. Such renders of a single RGB-D frame are the condition of
ViewCrafter (2409.02048), GEN3C (2503.03751) and TrajectoryCrafter (2503.05638).
"""

from __future__ import annotations

from typing import Final, NamedTuple

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from persist_backbones.adapters.splat import draw_means, hide_covered, rasterize
from persist_backbones.cogvideox.codec import Codec, to_uint8
from persist_backbones.distinct_views import distinct_views
from persist_backbones.tensors import clip_by_clip, latent_shares, push_pull
from persist_cli.api.cameras import Cameras
from persist_cli.api.geometry import unproject

FINER: Final = 2  # pixels that are drawn along the edge of a pixel of a view
SPREAD: Final = 1.5  # edge of a drawn point in pixels of the given frame, so that a floor seen at a slant has no holes
MOST: Final = 9  # pixels of a view along the edge of a drawn point, at most
THICKNESS: Final = 0.05  # metres behind the nearest point that are of the same surface


class GivenViews(NamedTuple):
    """What given frames show in the views of their clips; holes are filled from around them.

    Args:
        rgb: uint8 RGB; the first frame is the given one.
        depth: planar z in metres.
        covered: share of each pixel that shows what was given, 0 in holes.
    """

    rgb: UInt8[Tensor, "batch frame height width 3"]
    depth: Float[Tensor, "batch frame height width"]
    covered: Float[Tensor, "batch frame 1 height width"]


@torch.no_grad()
def views_of_given(
    codec: Codec, first: Float[Tensor, "batch 1 channel height width"], cameras: Cameras
) -> Float[Tensor, "batch latent_frame channel height width"]:
    """Return latents of what given frames show in all views of their clips, zeros where they show nothing.

    Args:
        codec: the codec of the latents.
        first: latents of the given frames alone; one of them may serve all clips.
        cameras: axes ``batch frame``.
    """
    colors, depth = codec.decode_images(first.float())
    rgb, metres = to_uint8(colors)[:, 0], depth[:, 0].float()
    if len(first) == 1 < len(cameras) and codec.framewise:  # each distinct view is drawn and encoded once
        distinct, numbers = distinct_views(cameras[:, 1:])
        given = cameras[0][:1]
        clips = Cameras.stack([Cameras.concatenate([given, distinct[number]]) for number in range(len(distinct))])
        drawn = _later_latents(codec, rgb, metres, clips).flatten(0, 1)[numbers]
    else:
        drawn = _later_latents(codec, rgb, metres, cameras)
    return torch.cat([first.expand(len(cameras), -1, -1, -1, -1), drawn.to(first)], dim=1)


def _later_latents(
    codec: Codec,
    rgb: UInt8[Tensor, "#batch height width 3"],
    depth: Float[Tensor, "#batch height width"],
    cameras: Cameras,
) -> Float[Tensor, "batch later channel height width"]:
    """Return latents of what given frames show in the views after the first, zeros where they show nothing."""
    rgb, depth = (part.expand(len(cameras), *part.shape[1:]) for part in (rgb, depth))
    drawn = clip_by_clip(render_given, rgb, depth, cameras=cameras, points=depth[0].numel(), finer=FINER)
    views = GivenViews(*drawn)
    shown = latent_shares(views.covered, codec.spatial, codec.temporal).any(dim=2, keepdim=True)
    if codec.framewise:  # the given frame is encoded already
        return codec.encode(views.rgb[:, 1:], views.depth[:, 1:]) * shown[:, 1:]
    return (codec.encode(views.rgb, views.depth) * shown)[:, 1:]


def render_given(
    rgb: UInt8[Tensor, "batch height width 3"], depth: Float[Tensor, "batch height width"], cameras: Cameras
) -> GivenViews:
    """Draw given frames with a z-buffer into all views of their clips; missing depth draws nothing.

    Args:
        rgb: the given frames.
        depth: their planar z in metres, 0 where it is missing.
        cameras: axes ``batch frame``; the first one of a clip is that of its given frame.
    """
    batch, frames = cameras.world_from_camera.shape[:2]
    first = cameras[:, :1]
    present = (depth > 0).flatten(1)
    views = cameras[:, 1:].resized(cameras.height * FINER, cameras.width * FINER)
    shape = (batch, frames - 1, views.height, views.width)
    sizes = SPREAD * depth.double() / first.intrinsics.double()[:, :1, 0, 0, None]
    splats = rasterize(unproject(depth[:, None], first).flatten(1, 3), present, views, sizes.flatten(1), MOST * FINER)
    visible, _ = hide_covered(splats, shape, THICKNESS)
    pictures, covered = draw_means(rgb.flatten(0, 2).float(), None, visible, shape, FINER).split([4, 1], dim=1)
    filled = push_pull(pictures, covered).unflatten(0, shape[:2])
    return GivenViews(
        torch.cat([rgb[:, None], filled[:, :, 1:].movedim(2, -1).round().to(torch.uint8)], dim=1),
        torch.cat([depth[:, None], filled[:, :, 0].to(depth)], dim=1),
        torch.cat([torch.ones_like(covered[:batch, None]), covered.unflatten(0, shape[:2])], dim=1),
    )
