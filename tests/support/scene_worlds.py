"""World models whose frames are renderings of the agents' scenes, cell by cell."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from persist_cli.api.actions import walking_actions
from persist_cli.api.backbone import Clips, Sampling
from persist_cli.api.cameras import Cameras
from persist_cli.api.cell_rays import first_surfaces, sheet_cells
from persist_cli.api.cells import CellGrid
from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.rollout.world_model import Agent, WorldModel
from persist_memory.scene.grid_scene import GridScene
from tests.support.micro_model import micro
from tests.support.room_worlds import BODY
from tests.support.rooms import UP, Room


def rendering(grid: CellGrid, cameras: Cameras) -> Observations:
    """What cameras see of cells."""
    surfaces = first_surfaces(grid, cameras, sheets=sheet_cells(grid, 0))
    depth = torch.where(surfaces.hit[0], surfaces.depth[0], 0.0).float()
    return Observations(surfaces.colors(grid)[0], depth, cameras)


class SceneWorld(WorldModel):
    """Imagines what each agent's scene holds when the clip begins."""

    def denoise(self, clips: Clips) -> tuple[Tensor, Tensor]:
        """Cast rays instead of denoising; all agents that move are the first ones."""
        seen = [
            rendering(agent.memory.cells, replace(clips.cameras, world_from_camera=poses, intrinsics=matrices))
            for agent, poses, matrices in zip(
                self.agents, clips.cameras.world_from_camera, clips.cameras.intrinsics, strict=False
            )
            if isinstance(agent.memory, GridScene)
        ]
        return torch.stack([one.rgb for one in seen]), torch.stack([one.depth for one in seen])


def scene_world(scene: GridScene, camera: Cameras) -> SceneWorld:
    """A world model whose agent stands in a scene and has observed what the scene shows from there."""
    room = replace(Room(camera.height, camera.width).info, vocabulary=walking_actions())
    info = TrajectoryInfo("room", camera.intrinsics[0].numpy(), camera.height, camera.width, UP, room.vocabulary)
    world = SceneWorld(micro(), [Agent(scene, body=BODY)], Sampling(1))
    world.reset([rendering(scene.cells, camera)], [info])
    return world
