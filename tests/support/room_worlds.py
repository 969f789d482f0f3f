"""World models that know the furnished room: what they imagine is ray traced, so that collisions can be computed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from persist_cli.api.actions import walking_actions
from persist_cli.api.backbone import Clips, Sampling
from persist_cli.api.cameras import Cameras
from persist_cli.api.ground import Body
from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.rollout.world_model import Agent, WorldModel
from tests.support.micro_model import micro
from tests.support.rooms import Room

ROOM = Room(64, 64)

BODY = Body(radius=0.2, camera_height=1.25, height=1.4)


def room_info() -> TrajectoryInfo:
    """The room, with steps of 0.25 m and turns of 15°."""
    return replace(ROOM.info, vocabulary=walking_actions())


def room_views(*poses: np.ndarray) -> Observations:
    """What a camera sees of the room from poses."""
    frames = list(ROOM.frames(np.stack(poses)))
    matrix = torch.from_numpy(ROOM.intrinsics).expand(len(frames), 3, 3)
    cameras = Cameras(torch.from_numpy(np.stack(poses)), matrix, ROOM.height, ROOM.width)
    rgb, depth = (torch.from_numpy(np.stack([getattr(f, name) for f in frames])) for name in ("rgb", "depth"))
    return Observations(rgb, depth, cameras)


class RoomWorld(WorldModel):
    """Imagines the room as it is, wherever its world's origin lies.

    Args:
        agents: one agent for each rollout.
        room_from_world: where the room lies in the agents' world.
    """

    def __init__(self, agents: list[Agent], room_from_world: Tensor | None = None) -> None:
        super().__init__(micro(), agents, Sampling(1))
        self.room_from_world = torch.eye(4, dtype=torch.float64) if room_from_world is None else room_from_world

    def denoise(self, clips: Clips) -> tuple[Tensor, Tensor]:
        """Ray trace the room instead of denoising."""
        poses = (self.room_from_world @ clips.cameras.world_from_camera).flatten(0, 1).numpy()
        seen = room_views(*poses)
        shape = clips.cameras.world_from_camera.shape[:2]
        return seen.rgb.unflatten(0, shape), seen.depth.unflatten(0, shape)

    def denoise_frame(self, clips: Clips, frames: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Ray trace a frame of each clip."""
        rgb, depth = self.denoise(clips)
        rows = torch.arange(len(frames))
        return rgb[rows, list(frames)], depth[rows, list(frames)]


def room_world(pose: np.ndarray, body: Body | None = BODY, agent: Agent | None = None) -> RoomWorld:
    """A world model whose agent stands in the room."""
    world = RoomWorld([agent or Agent(None, body=body)])
    world.reset([room_views(pose)], [room_info()])
    return world
