"""The camera's motion between RGB-D frames, as the frames show it: visual odometry by direct alignment.

A frame is laid over the one before so that colours and inverse depths of both agree (Steinbrücker, Sturm & Cremers
2011, "Real-Time Visual Odometry from Dense RGB-D Images"), with weights that take little notice of what does not fit
(Kerl, Sturm & Cremers 2013). Small images leave few gradients, so it starts from many motions; none of them is told.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from persist_cli.api.cameras import invert_rigid
from persist_cli.api.geometry import small_motions, unproject
from persist_cli.api.observations import Observations

LEVELS = {16: 6, 32: 4, 64: 2}  # pixels along the longer side, coarse to fine, and rounds of Gauss-Newton
KEPT = 9, 3  # starts that go on at their costs, and after a few rounds
TRIALS = 3  # so many
SIGHTED = 0.25  # share of a frame's pixels with depth that must lie in the other, or the motion is refused

COLOR, DEPTH = 0.1, 0.1  # of a channel's range and of the depth: a pixel that is so far off counts half
WHOLE = 0.99  # share of known depth among the four pixels around a place, below which it has none
LEAST_DEPTH = 0.1  # metres; nearer, or missing, is no depth

TURNS = tuple(7.5 * number for number in range(-5, 6))  # degrees to the right at the start, at most 37.5
STEPS = (-0.1, 0.0, 0.1)  # metres ahead at the start, for each metre of the view's median depth


@dataclass(frozen=True)
class Pairs:
    """Pairs of RGB-D frames at one size, float64; each pair may stand there many times.

    Args:
        points: what each pixel of the first frame shows, in the first camera, metres.
        values: its red, green and blue, 0 to 1, and inverse depth, 1/m.
        known: whether its depth is known.
        images: red, green, blue, inverse depth and known depth of the second frame, and how the first four change
            along u and v.
        intrinsics: of the second camera.
    """

    points: Float[Tensor, "pair pixel 3"]
    values: Float[Tensor, "pair pixel 4"]
    known: Bool[Tensor, "pair pixel"]
    images: Float[Tensor, "pair 13 height width"]
    intrinsics: Float[Tensor, "pair 3 3"]

    def __getitem__(self, index: Tensor) -> Pairs:
        return Pairs(
            self.points[index], self.values[index], self.known[index], self.images[index], self.intrinsics[index]
        )


def camera_motions(frames: Observations) -> Float[Tensor, "step 4 4"]:
    """The pose of each camera but the first in the frame of the one before, as colours and depths show it.

    Args:
        frames: at least two RGB-D frames; of their cameras only the intrinsics are read.

    Returns:
        Rigid transforms in metres, float64; NaN where too little depth is known. Frames that have nothing in common get
        the motion by which they differ least, which says nothing.
    """
    pairs = make_pairs(at_size(frames, min(LEVELS)))
    motions, costs = _from_starts(pairs, start_motions(pairs), LEVELS[min(LEVELS)])
    for side, rounds in list(LEVELS.items())[1:]:
        motions, costs = align(make_pairs(at_size(frames, side)), motions, rounds)
    return torch.where(costs.isfinite()[:, None, None], invert_rigid(motions), math.nan)


def _from_starts(pairs: Pairs, starts: Float[Tensor, "pair start 4 4"], rounds: int) -> tuple[Tensor, Tensor]:
    """The best motion of each pair and its cost, from the starts that come nearest in a few rounds."""
    count = len(starts)
    for kept, steps in zip((*KEPT, 1), (0, TRIALS, rounds), strict=True):
        tried = torch.arange(count).repeat_interleave(starts.shape[1])
        motions, costs = align(pairs[tried], starts.flatten(0, 1), steps)
        least, best = costs.view(count, -1).topk(kept, largest=False)
        starts = motions.view(count, -1, 4, 4)[torch.arange(count)[:, None], best]
    return starts[:, 0], least[:, 0]


def at_size(frames: Observations, side: int) -> Observations:
    """Frames of at most so many pixels along the longer side: means of colours, and the nearest depths."""
    factor = min(1.0, side / max(frames.depth.shape[1:]))
    height, width = (max(1, round(factor * size)) for size in frames.depth.shape[1:])
    rgb = torch.nn.functional.adaptive_avg_pool2d(frames.rgb.permute(0, 3, 1, 2).double(), (height, width))
    depth = torch.nn.functional.interpolate(frames.depth[:, None].double(), (height, width), mode="nearest-exact")
    return Observations(rgb.permute(0, 2, 3, 1), depth[:, 0], frames.cameras.resized(height, width))


def make_pairs(frames: Observations) -> Pairs:
    """Each frame but the last with the one that follows."""
    own = frames.cameras.at(torch.eye(4, dtype=torch.float64).expand(len(frames), 4, 4))
    known = frames.depth > LEAST_DEPTH
    inverse = torch.where(known, 1 / frames.depth.clamp_min(LEAST_DEPTH), 0.0)
    images = torch.cat([frames.rgb.permute(0, 3, 1, 2) / 255, inverse[:, None]], dim=1)
    down, right = torch.gradient(images, dim=(2, 3)) if min(images.shape[2:]) > 1 else (images * 0, images * 0)
    return Pairs(
        points=unproject(frames.depth, own)[:-1].flatten(1, 2),
        values=images[:-1].flatten(2).transpose(1, 2),
        known=known[:-1].flatten(1),
        images=torch.cat([images, known[:, None].double(), right, down], dim=1)[1:],
        intrinsics=own.intrinsics[1:].double(),
    )


def start_motions(pairs: Pairs) -> Float[Tensor, "pair start 4 4"]:
    """Motions of points to begin with, the same for all pairs but for the depth of what is seen."""
    depth = torch.stack([
        points[known, 2].median() if bool(known.any()) else points.new_zeros(())
        for points, known in zip(pairs.points, pairs.known, strict=True)
    ])  # fmt: skip
    turns, steps = torch.meshgrid(torch.tensor(TURNS).double(), torch.tensor(STEPS).double(), indexing="ij")
    zeros = torch.zeros(turns.numel(), dtype=torch.float64)
    poses = small_motions(torch.stack([zeros] * 3, -1), torch.stack([zeros, turns.flatten().deg2rad(), zeros], -1))
    poses = poses.expand(len(depth), -1, 4, 4).clone()
    poses[..., :3, 3] = poses[..., :3, 2] * (depth[:, None] * steps.flatten())[..., None]
    return invert_rigid(poses)


def align(
    pairs: Pairs, motions: Float[Tensor, "pair 4 4"], rounds: int
) -> tuple[Float[Tensor, "pair 4 4"], Float[Tensor, " pair"]]:
    """Motions of the first frames' points that fit the second frames best, and their costs (Gauss-Newton).

    Args:
        pairs: the frames.
        motions: where to begin.
        rounds: steps of Gauss-Newton; the best of all is returned.

    Returns:
        The motions, and the mean of log(1 + error²) over the pixels, infinite where too few are seen by both.
    """
    best, costs = motions, motions.new_full((len(motions),), math.inf)
    for number in range(rounds + 1):
        view = overlay(pairs, motions)
        better = view.cost < costs
        best, costs = torch.where(better[:, None, None], motions, best), torch.where(better, view.cost, costs)
        if number < rounds:
            motions = view.improved(motions)
    return best, costs


@dataclass(frozen=True)
class Overlay:
    """First frames laid over second ones by motions.

    Args:
        points: the first frames' points in the second cameras, metres.
        focal: focal lengths of the second cameras over the points' depths.
        errors: of colours and inverse depth, in deviations.
        seen: what both frames see.
        right: how errors change along u, a pixel.
        down: how they change along v.
    """

    points: Float[Tensor, "pair pixel 3"]
    focal: Float[Tensor, "pair pixel 2"]
    errors: Float[Tensor, "pair pixel 4"]
    seen: Bool[Tensor, "pair pixel"]
    right: Float[Tensor, "pair pixel 4"]
    down: Float[Tensor, "pair pixel 4"]

    @property
    def cost(self) -> Float[Tensor, " pair"]:
        """Mean of log(1 + error²) over all pixels; one that is not seen costs as much as one a deviation off."""
        cost = torch.where(self.seen, self.errors.square().log1p().mean(-1), math.log(2)).mean(-1)
        return torch.where(self.seen.double().mean(-1) >= SIGHTED, cost, math.inf)

    def improved(self, motions: Float[Tensor, "pair 4 4"]) -> Float[Tensor, "pair 4 4"]:
        """The motions after a step of Gauss-Newton."""
        slopes = self.slopes()
        weights = self.seen[..., None] / (1 + self.errors.square())
        weighted = (slopes * weights[..., None]).flatten(1, 2)
        normal = weighted.transpose(1, 2) @ slopes.flatten(1, 2)
        gradient = weighted.transpose(1, 2) @ self.errors.flatten(1)[..., None]
        damping = 1e-6 * (1 + normal.diagonal(dim1=1, dim2=2).mean(-1))
        step = -torch.linalg.solve(normal + damping[:, None, None] * torch.eye(6, dtype=normal.dtype), gradient)[..., 0]
        return small_motions(step[:, :3], step[:, 3:]) @ motions

    def slopes(self) -> Float[Tensor, "pair pixel 4 6"]:
        """How the errors change along translations and rotation vectors of the points."""
        x, y, z = self.points.unbind(-1)
        u, v = self.focal.unbind(-1)
        zero = torch.zeros_like(x)
        along_u = torch.stack([u, zero, -u * x / z], dim=-1)
        along_v = torch.stack([zero, v, -v * y / z], dim=-1)
        slopes = self.right[..., None] * along_u[..., None, :] + self.down[..., None] * along_v[..., None, :]
        slopes[..., 3, 2] += 1 / (z * DEPTH)  # the wanted inverse depth falls as a point goes away
        turned = torch.linalg.cross(self.points[..., None, :].expand_as(slopes), slopes, dim=-1)
        return torch.cat([slopes, turned], dim=-1)


def overlay(pairs: Pairs, motions: Float[Tensor, "pair 4 4"]) -> Overlay:
    """Lay the first frames over the second ones."""
    height, width = pairs.images.shape[2:]
    points = pairs.points @ motions[:, :3, :3].transpose(1, 2) + motions[:, None, :3, 3]
    ahead = points[..., 2] > LEAST_DEPTH
    points = torch.cat([points[..., :2], points[..., 2:].clamp_min(LEAST_DEPTH)], dim=-1)
    near = points[..., 2:]
    focal, middle = pairs.intrinsics[:, None, [0, 1], [0, 1]] / near, pairs.intrinsics[:, None, :2, 2]
    grid = 2 * (focal * points[..., :2] + middle) / points.new_tensor([width, height]) - 1
    sampled = torch.nn.functional.grid_sample(pairs.images, grid[:, None], align_corners=False, padding_mode="border")
    values, whole, right, down = sampled[:, :, 0].transpose(1, 2).split([4, 1, 4, 4], dim=-1)
    scale = torch.cat([(1 / COLOR) * torch.ones_like(points), near / DEPTH], dim=-1)
    wanted = torch.cat([pairs.values[..., :3], 1 / near], dim=-1)
    seen = ahead & (grid.abs() < 1).all(-1) & pairs.known & (whole[..., 0] > WHOLE)
    return Overlay(points, focal, scale * (values - wanted), seen, scale * right, scale * down)
