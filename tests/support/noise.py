"""Frames of noise, for tests of data that come back as they were."""

from __future__ import annotations

import numpy as np

from persist_cli.api.actions import walking_actions
from persist_cli.api.observations import Frame, TrajectoryInfo

INTRINSICS = np.array([[20.0, 0, 12], [0, 20, 8], [0, 0, 1]])

INFO = TrajectoryInfo("house-7", INTRINSICS, 16, 24, (0.0, 1.0, 0.0), walking_actions(0.3), {"seed": 7})


def make_frames(count: int = 20) -> list[Frame]:
    """Frames with random images and positions, always the same ones."""
    random = np.random.default_rng(0)
    frames = []
    for number in range(count):
        pose = np.eye(4)
        pose[:3, 3] = random.normal(size=3)
        rgb = random.integers(0, 256, (16, 24, 3), dtype=np.uint8)
        depth = random.uniform(0.5, 9, (16, 24)).astype(np.float32)
        frames.append(Frame(rgb, depth, pose, None if number == count - 1 else "forward", number / 10))
    return frames
