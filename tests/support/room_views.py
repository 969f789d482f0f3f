"""Observations of the furnished room and of the real kitchen, and memories of them."""

from __future__ import annotations

from collections.abc import Sequence
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


def observe(poses: Sequence[np.ndarray] | np.ndarray, height: int = 48, width: int = 64) -> Observations:
    """Views of the furnished room from these poses (world_from_camera)."""
    room = Room(height, width)
    frames = [room.see(pose) for pose in poses]
    intrinsics = torch.from_numpy(room.intrinsics).expand(len(poses), 3, 3)
    return Observations(
        torch.from_numpy(np.stack([frame.rgb for frame in frames])),
        torch.from_numpy(np.stack([frame.depth for frame in frames])),
        Cameras(torch.from_numpy(np.stack(poses)), intrinsics, height, width),
    )


def room_walk(frames: int = 8) -> Observations:
    """Views on a walk around the middle of the room."""
    return observe(walk(frames))


def write_room_walks(folder: Path, size: int, trajectories: int = 3, frames: int = 64) -> Path:
    """A data set of walks through the room in square images; each walk starts at another place of the round."""
    poses = walk(frames)
    for number in range(trajectories):
        turned = np.roll(poses, number * frames // trajectories, axis=0)
        Room(size, size).write(folder / f"walk-{number}.parquet", turned)
    return folder


def empty_memory(
    name: str, encoder: dict[str, Any] | None = None, up: tuple[float, float, float] = UP, **settings: Any
) -> Memory:
    """An empty memory of the room with the encoder ``patches``."""
    return make_memory(name, settings, make_encoder("patches", encoder or {}), FrameOfReference("room", up))


def written_memory(name: str, observations: Observations, **settings: Any) -> Memory:
    """A memory into which these frames were written."""
    memory = empty_memory(name, **settings)
    memory.write(observations)
    return memory


def moved(observations: Observations, motion: torch.Tensor) -> Observations:
    """The same images in a world that was moved as a whole."""
    cameras = observations.cameras
    return replace(observations, cameras=replace(cameras, world_from_camera=motion @ cameras.world_from_camera))


def translation(x: float, y: float, z: float) -> torch.Tensor:
    """A rigid motion by these metres, without a rotation."""
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, 3] = torch.tensor([x, y, z])
    return motion


def same_bits(one: Memory, other: Memory) -> bool:
    """Whether two memories hold equal tensors."""
    first, second = one.tensors(), other.tensors()
    return first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)


def kitchen_frames(numbers: list[int]) -> Observations:
    """Some of the 120 real Kinect frames; skips the test where they are not on this machine."""
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
