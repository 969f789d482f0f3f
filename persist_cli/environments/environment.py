"""A scene with an agent as a Gymnasium environment, alone and several in one batch."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from persist_cli.api.observations import TrajectoryInfo
from persist_cli.environments.task import (
    Array,
    Attempt,
    Observation,
    TaskSettings,
    View,
    action_space,
    moving_actions,
    observation_space,
)
from persist_cli.errors import DataError

RENDER_MODES = ["rgb_array"]
RESET_FIRST = "reset() comes before step() and render()"


class Scenes(ABC):
    """The scenes of some environments, each with one agent in it, numbered from 0.

    Args:
        info: image size, up axis and vocabulary of all of them.
        task: rewards and observations.
    """

    def __init__(self, info: TrajectoryInfo, task: TaskSettings) -> None:
        self.info, self.task = info, task

    @abstractmethod
    def begin(self, number: int, draws: np.random.Generator, options: Mapping[str, Any]) -> Attempt:
        """Begin an episode of an environment; equal draws give equal episodes.

        Args:
            number: of the environment.
            draws: source of all that is random.
            options: of ``reset``; empty for an episode that is drawn.

        Raises:
            PersistError: when no start and goal can be found, or the options cannot be used.
        """

    @abstractmethod
    def walk(self, actions: Mapping[int, Sequence[str]]) -> dict[int, list[View]]:
        """Let the agents of some environments act, all together, and return what each sees after each action."""


class HouseEnv(gymnasium.Env[Observation, Any]):
    """One scene with one agent.

    Args:
        scenes: hold this one.
        render_mode: ``rgb_array`` or ``None``.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": RENDER_MODES, "render_fps": 4}  # type: ignore[misc]

    def __init__(self, scenes: Scenes, render_mode: str | None = None) -> None:
        self.scenes, self.render_mode = scenes, render_mode
        self.actions = moving_actions(scenes.info)
        self.action_space = action_space(scenes.info, scenes.task)
        self.observation_space: spaces.Space[Any] = observation_space(scenes.info, scenes.task)
        self._attempt: Attempt | None = None

    @property
    def attempt(self) -> Attempt:
        """The present episode; ``gymnasium.error.ResetNeeded`` before the first."""
        if self._attempt is None:
            raise ResetNeeded(RESET_FIRST)
        return self._attempt

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode, drawn by the seed; a true house takes a given one as options."""
        super().reset(seed=seed)
        self._attempt = None  # of a reset that is refused nothing is left to go on with
        self._attempt = self.scenes.begin(0, self.np_random, options or {})
        return self.attempt.observation(), self.attempt.info()

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Take one action, or ``chunk`` of them; the episode ends at the goal.

        Raises:
            DataError: when they are not of the action space; nothing was done then.
        """
        attempt = self.attempt
        names = named(action, self.actions, self.scenes.task.chunk)
        reward = attempt.advance(self.scenes.walk({0: names})[0])
        return attempt.observation(), reward, attempt.reached, False, attempt.info()

    def render(self) -> Array | None:
        """Return what the agent sees now, uint8 ``[height, width, 3]``; ``None`` without a render mode."""
        return self.attempt.now.rgb.copy() if self.render_mode == "rgb_array" else None


class HouseVectorEnv(VectorEnv[Observation, Array, Array]):
    """Several scenes with one agent each, which act together; an episode that ends begins anew in the same step.

    The last observation and info of an episode that ended are ``final_obs`` and ``final_info``, as in Gymnasium's
    ``SyncVectorEnv`` with ``AutoresetMode.SAME_STEP``.

    Args:
        scenes: hold ``num_envs`` of them.
        num_envs: number of environments.
        max_episode_steps: steps after which an episode is truncated; ``None`` for no end.
        render_mode: ``rgb_array`` or ``None``.
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        "render_modes": RENDER_MODES, "render_fps": 4, "autoreset_mode": AutoresetMode.SAME_STEP,
    }  # fmt: skip

    def __init__(
        self, scenes: Scenes, num_envs: int, max_episode_steps: int | None = None, render_mode: str | None = None
    ) -> None:
        self.scenes, self.num_envs, self.render_mode = scenes, num_envs, render_mode
        self.max_episode_steps = max_episode_steps
        self.actions = moving_actions(scenes.info)
        self.single_action_space = action_space(scenes.info, scenes.task)
        self.single_observation_space = observation_space(scenes.info, scenes.task)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space: spaces.Space[Any] = batch_space(self.single_observation_space, num_envs)
        self._draws = [seeding.np_random(None)[0] for _ in range(num_envs)]
        self._attempts: list[Attempt] = []

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode in each environment.

        Args:
            seed: one for each environment, or that of the first, after which they count up; ``None`` goes on drawing.
            options: those of each single environment.
        """
        for number, one in enumerate(environment_seeds(seed, self.num_envs)):
            if one is not None:
                self._draws[number] = seeding.np_random(one)[0]
        self._attempts = []
        self._attempts = [self.scenes.begin(number, draws, options or {}) for number, draws in enumerate(self._draws)]
        infos: dict[str, Any] = {}
        for number, attempt in enumerate(self._attempts):
            infos = self._add_info(infos, attempt.info(), number)
        return self._observations(), infos

    def step(self, actions: Array) -> tuple[Observation, Array, Array, Array, dict[str, Any]]:
        """Take one action, or ``chunk`` of them, in each environment.

        Raises:
            DataError: when they are not of the action space; nothing was done then.
        """
        self._check_begun()
        if np.ndim(actions) == 0 or len(actions) != self.num_envs:
            raise DataError(f"actions of shape {np.shape(actions)}: {self.num_envs} environments take one each")
        names = {n: named(action, self.actions, self.scenes.task.chunk) for n, action in enumerate(actions)}
        views = self.scenes.walk(names)
        rewards = np.array([attempt.advance(views[number]) for number, attempt in enumerate(self._attempts)])
        reached = np.array([attempt.reached for attempt in self._attempts])
        truncated = np.array([self._is_over(attempt) for attempt in self._attempts])
        infos = self._begin_again(reached | truncated)
        return self._observations(), rewards, reached, truncated, infos

    def render(self) -> tuple[Array, ...] | None:
        """Return what each agent sees now; ``None`` without a render mode."""
        if self.render_mode != "rgb_array":
            return None
        self._check_begun()
        return tuple(attempt.now.rgb.copy() for attempt in self._attempts)

    def _check_begun(self) -> None:
        if not self._attempts:
            raise ResetNeeded(RESET_FIRST)

    def _is_over(self, attempt: Attempt) -> bool:
        return self.max_episode_steps is not None and attempt.steps >= self.max_episode_steps

    def _begin_again(self, ended: Array) -> dict[str, Any]:
        """Begin new episodes where one has ended, and return the infos of this step."""
        infos: dict[str, Any] = {}
        for number, attempt in enumerate(self._attempts):
            if ended[number]:
                final = {"final_obs": attempt.observation(), "final_info": attempt.info()}
                infos = self._add_info(infos, final, number)
                self._attempts[number] = self.scenes.begin(number, self._draws[number], {})
            infos = self._add_info(infos, self._attempts[number].info(), number)
        return infos

    def _observations(self) -> Observation:
        """What all agents observe now, in one batch."""
        rows = [attempt.observation() for attempt in self._attempts]
        return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def named(action: Any, names: Sequence[str], chunk: int) -> list[str]:
    """Return the names of the actions of one step.

    Args:
        action: a number, or ``chunk`` numbers.
        names: of all actions.
        chunk: number of actions that one step takes.

    Raises:
        DataError: for anything else, and a number that no action has.
    """
    numbers = np.asarray(action)
    wanted = "one" if chunk == 1 else f"a list of {chunk}"
    if numbers.dtype.kind not in "iu" or numbers.size != chunk or not ((numbers >= 0) & (numbers < len(names))).all():
        raise DataError(f"action {action}: a step takes {wanted} of 0 to {len(names) - 1} ({', '.join(names)})")
    return [names[number] for number in numbers.reshape(-1).tolist()]


def environment_seeds(seed: int | Sequence[int | None] | None, count: int) -> Sequence[int | None]:
    """Return a seed for each environment: the numbers from ``seed`` on, those given, or none.

    Raises:
        ValueError: when there are not as many as environments.
    """
    if seed is None or isinstance(seed, int | np.integer):
        return [None if seed is None else int(seed) + number for number in range(count)]
    if len(seed) != count:
        raise ValueError(f"{len(seed)} seeds for {count} environments")
    return seed
