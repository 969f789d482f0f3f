"""Observations of the furnished room and of the real kitchen, and empty memories of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from persist_cli.api.cameras import Cameras
from persist_cli.api.memory import FrameOfReference, Memory
from persist_cli.api.observations import Observations
from persist_cli.plugins import make_encoder, make_memory
from tests.support.rooms import UP, Room, walk

KITCHEN = Path(__file__).resolve().parents[3] / "shared/data/kitchen"

MEMORIES = ("none", "voxel", "map2d", "snapshots")


def observe(poses: np.ndarray, height: int = 48, width: int = 64) -> Observations:
    """What the room looks like from these world_from_camera."""
    room = Room(height, width)
    frames = [room.see(pose) for pose in poses]
    intrinsics = torch.from_numpy(room.intrinsics).expand(len(poses), 3, 3)
    return Observations(
        torch.from_numpy(np.stack([frame.rgb for frame in frames])),
        torch.from_numpy(np.stack([frame.depth for frame in frames])),
        Cameras(torch.from_numpy(np.asarray(poses)), intrinsics, height, width),
    )


def walked(frames: int = 8) -> Observations:
    """A walk through the room."""
    return observe(walk(frames))


def empty(
    name: str, encoder: dict[str, Any] | None = None, up: tuple[float, float, float] = UP, **settings: Any
) -> Memory:
    """An empty memory of the room."""
    return make_memory(name, settings, make_encoder("patches", encoder or {}), FrameOfReference("room", up))


def written(name: str, observations: Observations, **settings: Any) -> Memory:
    """A memory of some frames."""
    memory = empty(name, **settings)
    memory.write(observations)
    return memory


def moved(observations: Observations, motion: torch.Tensor) -> Observations:
    """The same images in a world that was moved as a whole."""
    cameras = observations.cameras
    return replace(observations, cameras=replace(cameras, world_from_camera=motion @ cameras.world_from_camera))


def shift(x: float, y: float, z: float) -> torch.Tensor:
    """A move of the world without turning."""
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, 3] = torch.tensor([x, y, z])
    return motion


def same_bits(one: Memory, other: Memory) -> bool:
    """Whether two memories hold the same to the bit."""
    mine, others = one.tensors(), other.tensors()
    return mine.keys() == others.keys() and all(torch.equal(mine[name], others[name]) for name in mine)


def kitchen(numbers: list[int]) -> Observations:
    """Some of the 120 real Kinect frames; skips where they are not at hand."""
    if not KITCHEN.is_dir():
        pytest.skip("the Kinect frames of ../shared/data/kitchen are not here")
    stems = sorted(path.name.removesuffix(".color.jpg") for path in KITCHEN.glob("*.color.jpg"))
    chosen = [KITCHEN / stems[number] for number in numbers]
    depth = np.stack([np.asarray(Image.open(f"{stem}.depth.png"), dtype=np.float32) for stem in chosen])
    depth[depth == 65535] = 0
    rgb = np.stack([np.asarray(Image.open(f"{stem}.color.jpg")) for stem in chosen])
    poses = torch.from_numpy(np.stack([np.loadtxt(f"{stem}.pose.txt") for stem in chosen]))
    intrinsics = torch.from_numpy(np.loadtxt(KITCHEN / "camera-intrinsics.txt")).expand(len(chosen), 3, 3)
    return Observations(torch.from_numpy(rgb), torch.from_numpy(depth / 1000), Cameras(poses, intrinsics, 480, 640))
