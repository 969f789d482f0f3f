"""The true scene of an episode: its views, its goal, the given walk, and the metres that are left to the goal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch

from persist_cli.api.cameras import Cameras
from persist_cli.api.observations import Frame, Observations, TrajectoryInfo
from persist_cli.api.policy import Goal
from persist_cli.api.simulator import Simulator, Stand
from persist_cli.episodes.episodes import Episode
from persist_cli.errors import DataError
from persist_cli.simulators.free_grid import Geodesic


def observations_of(frames: Sequence[Frame], info: TrajectoryInfo) -> Observations:
    """Return a simulator's frames as tensors, with the cameras of its scene."""
    poses = torch.from_numpy(np.stack([frame.world_from_camera for frame in frames]).astype(np.float64))
    intrinsics = torch.from_numpy(info.intrinsics).expand(len(frames), 3, 3)
    rgb = torch.from_numpy(np.stack([frame.rgb for frame in frames]))
    depth = torch.from_numpy(np.stack([frame.depth for frame in frames]).astype(np.float32))
    return Observations(rgb, depth, Cameras(poses, intrinsics, info.height, info.width))


def stand(simulator: Simulator, at: Stand) -> None:
    """Put the agent somewhere."""
    simulator.place(at.ground, at.heading)


def look(simulator: Simulator) -> Observations:
    """Return the present frame of the agent."""
    return observations_of([simulator.observe()], simulator.info)


def look_from(simulator: Simulator, at: Stand) -> Observations:
    """Return the frame that is seen from a place, and leave the agent there."""
    stand(simulator, at)
    return look(simulator)


class TrueScene:
    """An episode in its simulator, with the agent at the start.

    Args:
        simulator: of the episode's settings; its scene is opened.
        episode: the episode.

    Raises:
        DataError: when the simulator has another scene under this seed, or refuses start, goal or walk.
    """

    def __init__(self, simulator: Simulator, episode: Episode) -> None:
        self.simulator, self.episode = simulator, episode
        simulator.open_scene(episode.scene)
        if simulator.info.scene != episode.scene_name:
            raise DataError(
                f"episode {episode.name!r}: scene {episode.scene} is {simulator.info.scene!r} here, not "
                f"{episode.scene_name!r}; run the episodes with the simulator that they were made with"
            )
        self.geodesic = Geodesic(simulator, episode.goal.ground)
        self.goal_view = look_from(simulator, episode.goal)
        self.back_to_start()

    @property
    def info(self) -> TrajectoryInfo:
        """Camera, up axis and vocabulary of the scene; its source tells the agent's body, where the simulator does."""
        told = {name: getattr(self.simulator.settings, name, None) for name in ("camera_height", "radius")}
        info = self.simulator.info
        return replace(info, source=info.source | {name: value for name, value in told.items() if value is not None})

    @property
    def goal(self) -> Goal:
        """The goal as image and as place."""
        return Goal(self.goal_view.rgb[0], self.goal_view.cameras.centers[0], self.info.scene)

    @property
    def distance(self) -> float:
        """Geodesic metres from the agent to the goal."""
        return self.geodesic.metres(self.simulator.agent[0])

    def back_to_start(self) -> None:
        """Put the agent at the start."""
        stand(self.simulator, self.episode.start)

    def look(self) -> Observations:
        """Return the present frame."""
        return look(self.simulator)

    def look_and_measure(self) -> tuple[Observations, float]:
        """Return the present frame, and the geodesic metres to the goal."""
        return self.look(), self.distance

    def act_and_measure(self, actions: Sequence[str]) -> Iterator[tuple[Observations, float]]:
        """Act from where the agent is, and yield after each action what ``look_and_measure`` returns."""
        for action in actions:
            self.simulator.act(action)
            yield self.look_and_measure()

    def follow(self, actions: Sequence[str]) -> tuple[Observations, list[bool]]:
        """Act from where the agent is, and return the frames before, between and after, and what was allowed."""
        frames, allowed = [self.simulator.observe()], []
        for action in actions:
            allowed.append(self.simulator.act(action))
            frames.append(self.simulator.observe())
        return observations_of(frames, self.info), allowed

    def walk(self) -> Observations:
        """Return the given frames of the scene; the agent is back at the start afterwards.

        Raises:
            DataError: when the scene refuses an action of the walk.
        """
        walk = self.episode.walk
        stand(self.simulator, walk.start)
        frames, allowed = self.follow(self.info.vocabulary.parse(walk.actions) if walk.actions else ())
        self.back_to_start()
        if not all(allowed) or max(walk.keep) >= len(frames):
            raise DataError(f"episode {self.episode.name!r}: its scene does not allow the given walk")
        return frames[list(walk.keep)]

    def shortest_way(self) -> Observations:
        """Return the frames along the shortest way; the agent is back at the start afterwards.

        Raises:
            DataError: when the scene refuses an action of it.
        """
        self.back_to_start()
        frames, allowed = self.follow(self.info.vocabulary.parse(self.episode.actions))
        self.back_to_start()
        if not all(allowed):
            raise DataError(f"episode {self.episode.name!r}: its scene does not allow the shortest way")
        return frames
