"""World models whose frames are renderings of the agents' scenes, cell by cell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from persist_cli.api.actions import walking_actions
from persist_cli.api.backbone import Clips, Sampling
from persist_cli.api.cameras import Cameras
from persist_cli.api.cell_rays import first_surfaces, sheet_cells
from persist_cli.api.cells import FREE, Box, CellGrid
from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.api.scene_model import Given, SceneSamples
from persist_cli.rollout.world_model import Agent, WorldModel
from persist_memory.scene.grid_scene import GridScene
from tests.support.cell_rooms import WALL
from tests.support.drawn_scenes import DrawnWalls, empty_scene
from tests.support.micro_model import micro
from tests.support.room_views import observe
from tests.support.room_worlds import BODY
from tests.support.rooms import UP, Room, look


class FewWalls(DrawnWalls):
    """Unknown cells are free but for a few walls by the seed, which differs from window to window.

    ``windows`` counts what was imagined.
    """

    windows = 0

    def sample(self, samples: SceneSamples, steps: int) -> tuple[Tensor, Tensor]:
        self.windows += 1
        classes, colors = samples.classes.clone(), samples.colors.clone()
        walls = torch.rand(classes.shape[1:3], generator=torch.Generator().manual_seed(int(samples.seeds[0]))) < 0.03
        drawn = torch.where(walls, WALL, FREE)[None, ..., None].expand(classes.shape).to(classes.dtype)
        unknown = samples.given == Given.NOTHING
        classes[unknown], colors[unknown] = drawn[unknown], 150
        return classes, colors


def unseen_world(write: bool = True, size: int = 64) -> tuple[SceneWorld, GridScene]:
    """A world whose agent comes to see what its scene must imagine, and that scene."""
    scene = empty_scene(FewWalls(), foresight=3.0)
    scene.complete(Box((-1.9, 0, -1.9), (1.9, 2.7, 1.9)), seed=5)
    world = scene_world(scene, observe([look((0.0, 1.3, 0.0), 20.0, -10.0)], size, size).cameras)
    world.agents[0].write = write
    return world, scene


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

    def denoise_frame(self, clips: Clips, frames: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Return a single frame of each clip."""
        rgb, depth = self.denoise(clips)
        rows = torch.arange(len(rgb))
        return rgb[rows, torch.tensor(frames)], depth[rows, torch.tensor(frames)]


def scene_world(scene: GridScene, camera: Cameras) -> SceneWorld:
    """A world model whose agent stands in a scene and has observed what the scene shows from there."""
    room = replace(Room(camera.height, camera.width).info, vocabulary=walking_actions())
    info = TrajectoryInfo("room", camera.intrinsics[0].numpy(), camera.height, camera.width, UP, room.vocabulary)
    world = SceneWorld(micro(), [Agent(scene, body=BODY)], Sampling(1))
    world.reset([rendering(scene.cells, camera)], [info])
    return world
