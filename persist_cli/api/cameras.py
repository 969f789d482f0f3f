"""Pinhole cameras in the one convention of the project.

OpenCV axes (x right, y down, z forward), ``world_from_camera`` in metres, intrinsics in pixels with the
centre of the top-left pixel at (0.5, 0.5). Geometry is float64: a map's cells must not depend on where the
world's origin lies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from persist_cli.errors import DataError

RIGID_TOLERANCE = 1e-2  # real captures store poses with three to four digits
POSE_DIGITS = 9  # after the point of a pose's numbers; poses that differ only behind them are one


@dataclass(frozen=True)
class Cameras:
    """Posed pinhole cameras of one image size; they have any leading axes, usually the frame alone.

    Args:
        world_from_camera: rigid transforms in metres, OpenCV axes, usually float64.
        intrinsics: pinhole matrices in pixels, top-left pixel centre at (0.5, 0.5).
        height: image height in pixels.
        width: image width in pixels.
    """

    world_from_camera: Float[Tensor, "*batch 4 4"]
    intrinsics: Float[Tensor, "*batch 3 3"]
    height: int
    width: int

    @property
    def centers(self) -> Float[Tensor, "*batch 3"]:
        """The camera centres in world metres."""
        return self.world_from_camera[..., :3, 3]

    def __len__(self) -> int:
        return self.world_from_camera.shape[0]

    def __getitem__(self, index: int | slice | Tensor | list[int] | tuple[slice, slice]) -> Cameras:
        return replace(self, world_from_camera=self.world_from_camera[index], intrinsics=self.intrinsics[index])

    def to(self, device: torch.device | str) -> Cameras:
        """Return these cameras on ``device``."""
        return replace(self, world_from_camera=self.world_from_camera.to(device), intrinsics=self.intrinsics.to(device))

    def relative_to(self, reference: Float[Tensor, "4 4"]) -> Cameras:
        """Return these cameras in the frame of the camera ``reference``, a world_from_camera in metres."""
        return replace(self, world_from_camera=invert_rigid(reference) @ self.world_from_camera)

    def at(self, poses: Float[Tensor, "frame 4 4"]) -> Cameras:
        """Return cameras like this one, which has a frame axis of one, at other poses."""
        return replace(self, world_from_camera=poses, intrinsics=self.intrinsics.expand(len(poses), 3, 3))

    def resized(self, height: int, width: int) -> Cameras:
        """Return cameras with these views at another image size in pixels; intrinsics scale with it."""
        scale = self.intrinsics.new_tensor([width / self.width, height / self.height, 1.0])
        return replace(self, intrinsics=self.intrinsics * scale[:, None], height=height, width=width)

    def cropped(self, top: int, left: int, height: int, width: int) -> Cameras:
        """Return cameras of a window of ``height`` × ``width`` pixels whose first pixel is (``top``, ``left``)."""
        intrinsics = self.intrinsics.clone()
        intrinsics[..., 0, 2] -= left
        intrinsics[..., 1, 2] -= top
        return replace(self, intrinsics=intrinsics, height=height, width=width)

    def thinned(self, step: int) -> Cameras:
        """Return cameras of images of which every ``step``-th row and column is kept, the first at ``step // 2``."""
        height, width = (len(range(step // 2, side, step)) for side in (self.height, self.width))
        intrinsics = self.intrinsics.double().clone()
        intrinsics[..., :2, 2] -= step // 2 + 0.5  # from the centre of the first pixel that is kept
        intrinsics[..., :2, :] /= step
        intrinsics[..., :2, 2] += 0.5
        return replace(self, intrinsics=intrinsics, height=height, width=width)

    def distinct(self) -> tuple[Cameras, Int64[Tensor, "*batch"]]:
        """Return every distinct camera once, with the frame axis alone, and for each of these its number there.

        The distinct ones are in an order of their own. Those that differ by rounding alone, as after the same turns in
        another order, are one.
        """
        poses, matrices = self.world_from_camera.flatten(0, -3), self.intrinsics.flatten(0, -3)
        rows = torch.cat([poses.flatten(1), matrices.flatten(1)], dim=1)
        unique, positions = torch.unique(rows.round(decimals=POSE_DIGITS), dim=0, return_inverse=True)
        numbers = torch.arange(len(rows), device=rows.device)
        first = numbers.new_full((len(unique),), len(rows)).scatter_reduce(0, positions, numbers, "amin")
        distinct = replace(self, world_from_camera=poses[first], intrinsics=matrices[first])
        return distinct, positions.view(self.world_from_camera.shape[:-2])

    @staticmethod
    def stack(paths: Sequence[Cameras]) -> Cameras:
        """Return a batch of camera paths, which have one length and one image size."""
        return replace(
            paths[0],
            world_from_camera=torch.stack([path.world_from_camera for path in paths]),
            intrinsics=torch.stack([path.intrinsics for path in paths]),
        )

    @staticmethod
    def concatenate(parts: Sequence[Cameras]) -> Cameras:
        """Join camera paths of one image size along their frames."""
        return replace(
            parts[0],
            world_from_camera=torch.cat([part.world_from_camera for part in parts]),
            intrinsics=torch.cat([part.intrinsics for part in parts]),
        )


def invert_rigid(transform: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """Return the inverses of rigid transforms, by transposing their rotations."""
    rotation = transform[..., :3, :3].transpose(-1, -2)
    inverse = torch.zeros_like(transform)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3] = -(rotation @ transform[..., :3, 3:])[..., 0]
    inverse[..., 3, 3] = 1.0
    return inverse


def check_poses(poses: Float[Tensor, "frame 4 4"], where: str) -> None:
    """Raise ``DataError``, which begins with ``where``, when a pose is not a finite rigid transform (within 1 %)."""
    flawed = _first_flaw(poses)
    if flawed is not None:
        raise DataError(f"{where}: the pose of frame {flawed[0]} is {flawed[1]}")


def check_pose(pose: Float[Tensor, "4 4"], where: str) -> None:
    """Raise ``DataError`` as ``check_poses`` does, for a single pose."""
    flawed = _first_flaw(pose[None])
    if flawed is not None:
        raise DataError(f"{where}: the pose is {flawed[1]}")


def _first_flaw(poses: Float[Tensor, "frame 4 4"]) -> tuple[int, str] | None:
    """Return the number of the first pose that is no finite rigid transform, and what it is; ``None`` without one."""
    matrices = poses.detach().cpu().double().numpy()  # numpy takes a third of the time for a single pose
    finite = np.isfinite(matrices).all((1, 2))
    if not finite.all():
        return int((~finite).argmax()), "not finite"
    rotation = matrices[:, :3, :3]
    skew = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max((1, 2))
    bottom = np.abs(matrices[:, 3] - (0.0, 0.0, 0.0, 1.0)).max(1)
    bad = (skew > RIGID_TOLERANCE) | (bottom > RIGID_TOLERANCE) | (np.linalg.det(rotation) < 0)
    if not bad.any():
        return None
    return int(bad.argmax()), "not rigid (rotation and translation only, no scale or mirror)"


def check_intrinsics(intrinsics: Float[Tensor, "3 3"], where: str) -> None:
    """Raise ``DataError``, which begins with ``where``, when the matrix is no invertible pinhole matrix."""
    finite = bool(torch.isfinite(intrinsics).all())
    below = intrinsics.tril(-1).abs().amax() > 1e-6
    corner = abs(float(intrinsics[2, 2]) - 1) > 1e-6
    if not finite or intrinsics[0, 0] <= 0 or intrinsics[1, 1] <= 0 or corner or below:
        values = [round(float(value), 3) for value in intrinsics.flatten()]
        turned = "; they look transposed" if finite and below and not intrinsics.triu(1).any() else ""
        raise DataError(f"{where}: the intrinsics {values} are singular or not a pinhole matrix{turned}")
