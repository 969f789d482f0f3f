"""A dataset that LeRobot wrote is read as LeRobot reads it; skipped where LeRobot is not installed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from persist_cli.data.importers.lerobot import LeRobot
from persist_cli.data.importers.lerobot_info import LeRobotSettings
from tests.support.lerobot_datasets import COLOR, DEPTH, RATE, ROOM, poses, save_intrinsics, stored_depth

lerobot = pytest.importorskip("lerobot.datasets.lerobot_dataset")

LENGTHS = (4, 3)


def write(folder: Path, kind: str, unit: str) -> None:
    """Write the room by LeRobot, with images of a kind and depth in a unit."""
    height, width = ROOM.height, ROOM.width
    image = {"dtype": kind, "names": ["height", "width", "channels"]}
    features = {
        "observation.pose": {"dtype": "float32", "shape": (7,), "names": ["x", "y", "z", "qx", "qy", "qz", "qw"]},
        COLOR: {**image, "shape": (height, width, 3)},
        DEPTH: {**image, "shape": (height, width, 1), "info": {"is_depth_map": True}},
    }
    dataset = lerobot.LeRobotDataset.create(
        repo_id="tests/room", fps=RATE, features=features, root=folder, use_videos=kind == "video"
    )
    numbers, path = poses(sum(LENGTHS), "quaternion")
    frames = iter(zip(numbers.astype(np.float32), ROOM.frames(path), strict=True))
    for length in LENGTHS:
        for _ in range(length):
            pose, frame = next(frames)
            depth = stored_depth(frame.depth, unit)[..., None]
            dataset.add_frame({"observation.pose": pose, COLOR: frame.rgb, DEPTH: depth, "task": "walk"})
        dataset.save_episode()
    dataset.finalize()
    save_intrinsics(folder)


@pytest.mark.parametrize(("kind", "unit"), [("video", "m"), ("video", "mm"), ("image", "m"), ("image", "mm")])
def test_what_lerobot_writes_is_read_as_it_reads_it_itself(tmp_path: Path, kind: str, unit: str) -> None:
    folder = tmp_path / "room"
    write(folder, kind, unit)
    own = lerobot.LeRobotDataset("tests/room", root=folder, video_backend="pyav", depth_output_unit="m")
    episodes = list(LeRobot(LeRobotSettings(pose="observation.pose")).trajectories(folder))
    assert [episode.length for episode in episodes] == list(LENGTHS)
    frames = [frame for episode in episodes for frame in episode.frames]
    for number, frame in enumerate(frames):
        item: dict[str, Any] = own[number]
        rgb = np.rint(item[COLOR].permute(1, 2, 0).numpy() * 255).astype(np.uint8)
        assert np.array_equal(frame.rgb, rgb)
        known = frame.depth > 0
        assert (~known).sum() == 1  # that of the missing depth, which LeRobot gives as the nearest one in a video
        assert np.abs(frame.depth - item[DEPTH].squeeze().numpy())[known].max() < 2e-6
