"""The task of an episode, reaching a goal: what the agent observes of it, and its reward from poses and the map.

No learned head takes part. Imagined and simulated houses share all of this, so that an agent can learn in the first and
be measured in the second.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from gymnasium import spaces

from persist_cli.api.observations import TrajectoryInfo
from persist_cli.api.policy import Goal
from persist_cli.errors import DataError

FARTHEST: Final = 100.0  # metres; observed depth ends there

LARGEST_OFFSET: Final = 1000.0  # metres of observed positions that the spaces allow

Array = np.ndarray[Any, Any]

Observation = dict[str, Array]


@dataclass(frozen=True)
class TaskSettings:
    """What the agent observes of its goal, and what it is rewarded for.

    Args:
        observe_goal: ``image`` for the view at the goal; ``place`` for where the goal lies from the agent.
        distance: ``geodesic`` for the way round what is in the way, ``straight`` for the straight line through it.
        success_radius: metres to the goal at which it is reached, which ends the episode.
        success_bonus: reward for reaching the goal.
        step_cost: taken off the reward for each action.
        collision_penalty: taken off the reward for each action that was blocked.
        goal_distance: least and largest metres between start and goal, where one of them is drawn.
        chunk: number of actions that one step takes at once.
    """

    observe_goal: Literal["image", "place"] = "image"
    distance: Literal["geodesic", "straight"] = "geodesic"
    success_radius: float = 1.0
    success_bonus: float = 2.5
    step_cost: float = 0.01
    collision_penalty: float = 0.05
    goal_distance: tuple[float, float] = (1.5, 8.0)
    chunk: int = 1

    def __post_init__(self) -> None:
        if self.success_radius <= 0:
            raise ValueError(f"success_radius {self.success_radius} is not above 0 m")
        if not self.success_radius < self.goal_distance[0] <= self.goal_distance[1]:
            low, high = self.goal_distance
            raise ValueError(
                f"goal_distance {low:g} to {high:g} m: it must begin beyond the success_radius of "
                f"{self.success_radius:g} m, the lower end first"
            )
        if self.chunk < 1:
            raise ValueError(f"chunk {self.chunk}: a step takes at least 1 action")

    def is_far_enough(self, metres: float) -> bool:
        """Whether a goal this far from a start may be drawn."""
        return self.goal_distance[0] <= metres <= self.goal_distance[1]


@dataclass(frozen=True)
class View:
    """What an agent sees after an action, and where it is.

    Args:
        rgb: uint8 ``[height, width, 3]``, 0…255.
        depth: float32 ``[height, width]`` metres, planar z, 0 = missing.
        world_from_camera: float64 ``[4, 4]``, metres, OpenCV axes.
        left: metres to the goal.
        free: whether the way of the action was free; else the agent stayed where it was.
    """

    rgb: Array
    depth: Array
    world_from_camera: Array
    left: float
    free: bool = True


def moving_actions(info: TrajectoryInfo) -> tuple[str, ...]:
    """Return the actions that walk ahead or turn, in the order of the vocabulary: action 0 is the first of them.

    Raises:
        DataError: when there are none, as in a capture.
    """
    names = tuple(action.name for action in info.vocabulary.moving)
    if not names:
        raise DataError(f"{info.scene}: no action moves the camera ({info.vocabulary.listing()})")
    return names


def action_space(info: TrajectoryInfo, task: TaskSettings) -> spaces.Space[Any]:
    """Return the space of a step: one of the moving actions, or ``chunk`` of them."""
    count = len(moving_actions(info))
    return spaces.Discrete(count) if task.chunk == 1 else spaces.MultiDiscrete([count] * task.chunk)


def observation_space(info: TrajectoryInfo, task: TaskSettings) -> spaces.Dict:
    """Return the space of ``Attempt.observation``."""
    image = (info.height, info.width)
    place = spaces.Box(-LARGEST_OFFSET, LARGEST_OFFSET, (2,), np.float32)
    pose = np.array([LARGEST_OFFSET, LARGEST_OFFSET, 1.0, 1.0], np.float32)
    return spaces.Dict(
        {
            "rgb": spaces.Box(0, 255, (*image, 3), np.uint8),
            "depth": spaces.Box(0.0, FARTHEST, image, np.float32),
            "goal": spaces.Box(0, 255, (*image, 3), np.uint8) if task.observe_goal == "image" else place,
            "pose": spaces.Box(-pose, pose, dtype=np.float32),
        }
    )


class Attempt:
    """One episode on its way: where the agent is, what it is rewarded for, and what it observes.

    Args:
        start: the view at the start.
        goal: what shall be reached.
        world_up: vector that points up in the world.
        task: rewards and observations.
    """

    def __init__(self, start: View, goal: Goal, world_up: Sequence[float], task: TaskSettings) -> None:
        self.goal, self.task, self.now = goal, task, start
        self.steps, self.collisions, self.walked, self.first_left = 0, 0, 0.0, start.left
        self._up = np.array(world_up, np.float64) / np.linalg.norm(world_up)
        self._start = start

    @property
    def reached(self) -> bool:
        """Whether the agent is within the success radius of its goal."""
        return self.now.left <= self.task.success_radius

    def advance(self, views: Sequence[View]) -> float:
        """Go on to the views after the actions of one step, up to the first at the goal, and return the reward."""
        self.steps += 1
        reward = 0.0
        for view in views:
            reward += self._reward(view)
            if self.reached:
                return reward + self.task.success_bonus
        return reward

    def observation(self) -> Observation:
        """Return what the agent observes now, in new arrays.

        ``pose`` is where the agent is from its start: metres ahead, metres to the left, and cosine and sine of the
        angle by which it is turned to the left. A ``goal`` that is a place is metres ahead and to the left of the
        agent.
        """
        now = self.now.world_from_camera
        ahead, left = self._offset(self._start.world_from_camera, now[:3, 3])
        ahead_now, left_now = self._directions(self._start.world_from_camera) @ self._directions(now)[0]
        return {
            "rgb": self.now.rgb.copy(),
            "depth": np.clip(self.now.depth, 0.0, FARTHEST).astype(np.float32),
            "goal": self._observed_goal(),
            "pose": np.array([ahead, left, np.clip(ahead_now, -1, 1), np.clip(left_now, -1, 1)], np.float32),
        }

    def info(self) -> dict[str, Any]:
        """Return figures of the episode so far; ``is_success`` is the name that stable-baselines3 counts."""
        return {
            "is_success": self.reached,
            "distance": self.now.left,
            "first_distance": self.first_left,
            "walked": self.walked,
            "collisions": self.collisions,
        }

    def _reward(self, view: View) -> float:
        """Make a view the present one, and return the reward of the action before it."""
        before, self.now = self.now, view
        self.walked += math.dist(before.world_from_camera[:3, 3], view.world_from_camera[:3, 3])
        self.collisions += not view.free
        penalty = self.task.step_cost + self.task.collision_penalty * (not view.free)
        return before.left - view.left - penalty

    def _observed_goal(self) -> Array:
        if self.task.observe_goal == "image":
            if self.goal.rgb is None:
                raise DataError(f"{self.goal.scene}: the goal has no image; give observe_goal='place'")
            return self.goal.rgb.numpy().copy()
        if self.goal.position is None:
            raise DataError(f"{self.goal.scene}: the goal has no place; give observe_goal='image'")
        return self._offset(self.now.world_from_camera, self.goal.position.numpy()).astype(np.float32)

    def _offset(self, world_from_camera: Array, position: Array) -> Array:
        """Metres ahead and to the left of a camera at which a world position lies."""
        return np.asarray(self._directions(world_from_camera) @ (position - world_from_camera[:3, 3]))

    def _directions(self, world_from_camera: Array) -> Array:
        """The unit vectors ahead of and to the left of a camera on the ground, as rows."""
        ahead = world_from_camera[:3, 2] - self._up * (self._up @ world_from_camera[:3, 2])
        ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
        return np.stack([ahead, np.cross(self._up, ahead)])
