"""Predictions and random weights for the tests of metrics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from persist_cli.api.cameras import Cameras
from persist_cli.api.observations import Observations
from persist_cli.io.files import write_json, write_tensors
from persist_cli.metrics.metric import Prediction, Setup
from tests.support.rooms import Room, look

SETUP = Setup(clips=20, frames=49, height=64, width=64, depth=True, generated_depth=True, returns=True)


def random_frames(seed: int, frames: int = 2, size: int = 32) -> tuple[torch.Tensor, torch.Tensor]:
    """Random colours and depths between 1 and 2 m."""
    draw = torch.Generator().manual_seed(seed)
    rgb = torch.randint(0, 256, (frames, size, size, 3), generator=draw, dtype=torch.uint8)
    return rgb, torch.rand(frames, size, size, generator=draw) + 1


def still_camera(rgb: torch.Tensor, depth: torch.Tensor) -> Observations:
    """These frames as the observations of a camera that does not move."""
    frames, height, width = depth.shape
    intrinsics = torch.tensor([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]]).double()
    cameras = Cameras(torch.eye(4).double().expand(frames, 4, 4), intrinsics.expand(frames, 3, 3), height, width)
    return Observations(rgb, depth, cameras)


def prediction(rgb: torch.Tensor, depth: torch.Tensor, truth: Observations) -> Prediction:
    """A generated video beside the truth that returns to no earlier pose."""
    return Prediction(rgb, depth, truth, torch.full((len(rgb),), -1))


def observe_room(poses: np.ndarray, room: Room | None = None) -> Observations:
    """The views of the furnished room from these world_from_camera poses."""
    room = room or Room(48, 48)
    frames = list(room.frames(poses))
    intrinsics = torch.from_numpy(room.intrinsics).expand(len(poses), 3, 3)
    return Observations(
        torch.from_numpy(np.stack([frame.rgb for frame in frames])),
        torch.from_numpy(np.stack([frame.depth for frame in frames])),
        Cameras(torch.from_numpy(poses), intrinsics, room.height, room.width),
    )


def there_and_back() -> Prediction:
    """The truth of a turn of 90° to the left and back: frames 4 to 6 return to frames 2, 1 and 0."""
    yaws = (0.0, 30.0, 60.0, 90.0, 60.0, 30.0, 0.0)
    truth = observe_room(np.stack([look((0.0, 1.3, 0.2), yaw, 0.0) for yaw in yaws]))
    return Prediction(truth.rgb, truth.depth, truth, torch.tensor([-1, -1, -1, -1, 2, 1, 0]))


def setup(**changes: object) -> Setup:
    """A setup that every metric can be measured of, with some changes."""
    return replace(SETUP, **changes)


def cache_random(cache: Path, name: str, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Cache random tensors of these shapes as the weights of a name; heads and variances are positive."""
    draw = torch.Generator().manual_seed(0)
    tensors = {key: torch.randn(shape, generator=draw) for key, shape in shapes.items()}
    for key, tensor in tensors.items():
        tensor /= max(1.0, tensor[0].numel() ** 0.5)
        if key.startswith("head") or key.endswith("var"):
            tensor.abs_()
    write_tensors(cache / "weights" / name / "model.safetensors", tensors)
    write_json(cache / "weights" / name / "weight.json", {"name": name, "sha256": "0" * 64})
