"""What may be wrong with a data set's conventions, and how each fault is undone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch

from persist_cli.world.cameras import Cameras, invert_rigid
from persist_cli.world.geometry import camera_rays
from persist_cli.world.observations import Observations

UNITS = {  # what mends the depth, and whose fault it may be
    1000.0: "divided by 1000 twice?",
    0.001: "millimetres taken for metres?",
    100.0: "divided by 100 twice?",
    0.01: "centimetres taken for metres?",
    10.0: "",
    0.1: "",
    5.0: "millimetres divided by 5000?",
    0.2: "TUM depth, 5000 to the metre, divided by 1000?",
}
RATIOS = (0.25, 0.33, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.1, 1.25, 1.4, 1.6, 2.0, 2.5, 3.0, 4.0)
GROSS = (0.2, 0.5, 2.0, 5.0)


@dataclass(frozen=True)
class Hypothesis:
    """A fault that the data may have.

    Args:
        name: of the kind of fault; what the report's ``undecided`` lists.
        cause: one sentence for people, with what to do.
        undo: mends a pair of frames that has this fault.
        gross: the fault is so large that data which cannot tell it apart tell nothing about its kind.
    """

    name: str
    cause: str
    undo: Callable[[Observations], Observations]
    gross: bool = True


def hypotheses(cameras: Cameras) -> list[Hypothesis]:
    """Every fault that is tried on frames of these cameras."""
    return [*_poses(), _along_the_ray(), *_scales(), *_intrinsics(cameras)]


def _poses() -> list[Hypothesis]:
    inverted = "the poses look inverted: they are camera_from_world, invert them"
    opengl = "the camera axes look like OpenGL's (y up, z backward): flip the y and z columns of the poses"
    both = f"{inverted}; and {opengl}"
    return [
        Hypothesis("inverted poses", inverted, partial(_with_poses, change=invert_rigid)),
        Hypothesis("OpenGL axes", opengl, partial(_with_poses, change=_flip)),
        Hypothesis("inverted poses", both, partial(_with_poses, change=lambda poses: _flip(invert_rigid(poses)))),
    ]


def _along_the_ray() -> Hypothesis:
    cause = "the depth looks measured along the ray: divide it by the length of K⁻¹(u, v, 1) to get planar z"
    return Hypothesis("depth along the ray", cause, _planar)


def _scales() -> list[Hypothesis]:
    """The usual units and any other ratio."""
    found = []
    for scale in (*UNITS, *RATIOS):
        size = f"{scale:g} times too small" if scale > 1 else f"{round(1 / scale, 2):g} times too large"
        hint = f" ({UNITS[scale]})" if UNITS.get(scale) else ""
        cause = f"the depth looks {size} for the positions{hint}: multiply it by {scale:g}"
        found.append(Hypothesis("depth units", cause, partial(_scaled, scale=scale), scale in GROSS))
    return found


def _intrinsics(cameras: Cameras) -> list[Hypothesis]:
    """The image size at which the principal point would be central, and any other ratio."""
    matrix = cameras.intrinsics[0]
    width, height = 2 * float(matrix[0, 2]), 2 * float(matrix[1, 2])
    found = []
    if width > 1 and height > 1 and abs(width / cameras.width - 1) > 0.05:
        found.append(_resized(cameras, cameras.width / width, cameras.height / height))
    return found + [_resized(cameras, ratio, ratio) for ratio in RATIOS]


def _resized(cameras: Cameras, x: float, y: float) -> Hypothesis:
    size = f"{round(cameras.height / y)}×{round(cameras.width / x)}"
    cause = (
        f"the intrinsics look made for images of about {size}, these are {cameras.height}×{cameras.width}: "
        f"multiply their first row by {x:.3g} and their second by {y:.3g}"
    )
    return Hypothesis("intrinsics of another size", cause, partial(_with_intrinsics, x=x, y=y), x in GROSS)


def _with_poses(pair: Observations, change: Callable[[torch.Tensor], torch.Tensor]) -> Observations:
    return replace(pair, cameras=replace(pair.cameras, world_from_camera=change(pair.cameras.world_from_camera)))


def _flip(poses: torch.Tensor) -> torch.Tensor:
    return poses @ torch.diag(poses.new_tensor([1.0, -1.0, -1.0, 1.0]))


def _planar(pair: Observations) -> Observations:
    return replace(pair, depth=(pair.depth / camera_rays(pair.cameras).norm(dim=-1)).float())


def _scaled(pair: Observations, scale: float) -> Observations:
    return replace(pair, depth=pair.depth * scale)


def _with_intrinsics(pair: Observations, x: float, y: float) -> Observations:
    scale = pair.cameras.intrinsics.new_tensor([x, y, 1.0])[:, None]
    return replace(pair, cameras=replace(pair.cameras, intrinsics=pair.cameras.intrinsics * scale))
