"""Observations and trajectories: posed RGB-D frames, the actions between them, and their source."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from persist_cli.api.actions import ActionVocabulary
from persist_cli.api.cameras import Cameras, check_poses
from persist_cli.api.cells import CellGrid
from persist_cli.errors import DataError


@dataclass(frozen=True)
class Frame:
    """One posed RGB-D image of a simulator or importer.

    Args:
        rgb: ``[height, width, 3]`` uint8, 0…255.
        depth: ``[height, width]`` float32 metres, planar z, 0 = missing.
        world_from_camera: ``[4, 4]`` float64, OpenCV axes, metres.
        action: name of the agent's action that leads to the next frame; ``None`` at the last.
        timestamp: seconds since any fixed time.
        cells: the scene as it is at this frame, where that is known; the same box in all frames.
    """

    rgb: np.ndarray[Any, Any]
    depth: np.ndarray[Any, Any]
    world_from_camera: np.ndarray[Any, Any]
    action: str | None = None
    timestamp: float = 0.0
    cells: CellGrid | None = None


@dataclass(frozen=True)
class TrajectoryInfo:
    """Properties that all frames of a trajectory share.

    Args:
        scene: name of the frame of reference; trajectories of one scene share the world's origin.
        intrinsics: ``[3, 3]`` float64, pixels, top-left pixel centre at (0.5, 0.5).
        height: image height in pixels.
        width: image width in pixels.
        world_up: unit vector that points up in the world.
        vocabulary: the agent's actions with their units.
        source: JSON values about the origin of the data.
    """

    scene: str
    intrinsics: np.ndarray[Any, Any]
    height: int
    width: int
    world_up: tuple[float, float, float]
    vocabulary: ActionVocabulary
    source: dict[str, Any] = field(default_factory=dict)


class Origin(IntEnum):
    """Where a frame comes from, and what a memory holds of it; where two meet in a memory, the higher one stays."""

    IMAGINED = 1
    OBSERVED = 2


@dataclass(frozen=True)
class Observations:
    """Posed RGB-D frames as tensors.

    Args:
        rgb: uint8, 0…255.
        depth: float32 metres, planar z, 0 = missing.
        cameras: one camera for each frame, of the images' size.
        origins: the ``Origin`` of each frame; without it all are observed.
    """

    rgb: UInt8[Tensor, "frame height width 3"]
    depth: Float[Tensor, "frame height width"]
    cameras: Cameras
    origins: UInt8[Tensor, " frame"] = None  # type: ignore[assignment]  # set below

    def __post_init__(self) -> None:
        if self.origins is None:
            object.__setattr__(self, "origins", origins_like(self.rgb, Origin.OBSERVED))

    def __len__(self) -> int:
        return self.rgb.shape[0]

    def __getitem__(self, index: slice | Tensor | list[int]) -> Observations:
        return Observations(self.rgb[index], self.depth[index], self.cameras[index], self.origins[index])

    def to(self, device: torch.device | str) -> Observations:
        """Return these frames on ``device``."""
        return Observations(
            self.rgb.to(device), self.depth.to(device), self.cameras.to(device), self.origins.to(device)
        )

    def with_origin(self, origin: Origin) -> Observations:
        """Return these frames, all of one origin."""
        return replace(self, origins=origins_like(self.rgb, origin))

    def without_depth(self) -> Observations:
        """Return these frames with all depth missing (0)."""
        return replace(self, depth=torch.zeros_like(self.depth))

    def by_origin(self) -> list[tuple[Origin, Observations]]:
        """Return the frames of each origin that there is, in their order, the observed ones first."""
        values = sorted(set(self.origins.tolist()), reverse=True)
        if len(values) == 1:
            return [(Origin(values[0]), self)]
        return [(Origin(value), self[self.origins == value]) for value in values]

    @staticmethod
    def concatenate(parts: Sequence[Observations]) -> Observations:
        """Join sequences of frames of one image size."""
        return Observations(
            torch.cat([part.rgb for part in parts]),
            torch.cat([part.depth for part in parts]),
            Cameras.concatenate([part.cameras for part in parts]),
            torch.cat([part.origins for part in parts]),
        )


def check_observations(observations: Observations, where: str) -> None:
    """Check that frames agree in number and size, and their types and poses.

    Args:
        observations: the frames.
        where: what an error begins with.

    Raises:
        DataError: when sizes differ, colours are not uint8, depth is not of floats, or a pose is not finite and rigid.
    """
    cameras, rgb, depth = observations.cameras, observations.rgb, observations.depth
    size = (len(observations), cameras.height, cameras.width)
    sizes = {tuple(rgb.shape[:3]), tuple(depth.shape), size}
    if len(sizes) > 1 or not len(cameras) == len(observations.origins) == len(observations):
        raise DataError(f"{where}: rgb, depth, cameras and origins differ in frames or size: {sorted(sizes)}")
    if rgb.dtype != torch.uint8 or rgb.shape[3:] != (3,):
        raise DataError(
            f"{where}: rgb is {rgb.dtype} {list(rgb.shape)}, not uint8 [frame, height, width, 3] of 0 to 255"
        )
    if not depth.is_floating_point():
        raise DataError(f"{where}: depth is {depth.dtype}, not floats in metres")
    check_poses(cameras.world_from_camera.cpu(), where)


def origins_like(rows: Tensor, origin: Origin) -> UInt8[Tensor, " row"]:
    """Return one origin for each row of a tensor, on its device."""
    return torch.full(rows.shape[:1], origin, dtype=torch.uint8, device=rows.device)


@dataclass(frozen=True)
class Trajectory:
    """Some consecutive frames of a trajectory, with the actions taken at each of them.

    Args:
        name: unique within its data set.
        observations: the frames.
        actions: one name for each frame; ``actions[i]`` leads from frame i to i + 1, the last may be ``None``.
        info: properties that all frames share.
        first: number of the first of these frames in the whole trajectory, counted from 0.
    """

    name: str
    observations: Observations
    actions: tuple[str | None, ...]
    info: TrajectoryInfo
    first: int = 0

    @property
    def world_up(self) -> Float[Tensor, " 3"]:
        """The unit vector that points up in the world, float64."""
        return torch.tensor(self.info.world_up, dtype=torch.float64)

    def __len__(self) -> int:
        return len(self.observations)
