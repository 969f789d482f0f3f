"""stable-baselines3 on the environments: several of one batch as it takes them, a small network, and its success.

For example ``PPO("MultiInputPolicy", VecMonitor(BatchedVecEnv(gymnasium.make_vec("persist/ImaginedHouse-v0", …))))``.
Single environments need none of this: ``PPO("MultiInputPolicy", gymnasium.make("persist/ImaginedHouse-v0", …))``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from jaxtyping import Float
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecMonitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnv
from torch import Tensor

from persist_cli.environments.task import FARTHEST, Array, Observation
from persist_cli.errors import PersistError

Indices = int | Iterable[int] | None

DEPTH_COLUMNS: Final = 16

USUAL_METRES: Final = 5.0  # of depths and goals, by which they are divided


class BatchedVecEnv(VecEnv):  # type: ignore[misc]
    """A vector environment of Gymnasium, stepped as one batch, with the face of stable-baselines3's ``VecEnv``.

    Args:
        envs: begins an ended episode anew in the same step, as those of persist do.

    Raises:
        PersistError: when it does not.
    """

    def __init__(self, envs: VectorEnv[Observation, Array, Array]) -> None:
        mode = envs.metadata.get("autoreset_mode")
        if mode != AutoresetMode.SAME_STEP:
            raise PersistError(
                f"{envs}: its autoreset_mode is {mode}; stable-baselines3 needs {AutoresetMode.SAME_STEP}"
            )
        self.envs = envs
        self._actions: Array = np.zeros(0)
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> Observation:
        """Begin an episode in each environment, with the seeds of ``seed`` and the options of ``set_options``.

        Raises:
            PersistError: when the environments have different options, for they begin together.
        """
        options, *others = self._options
        if any(other != options for other in others):
            raise PersistError("set_options: all environments of a batch take the same options")
        seen, infos = self.envs.reset(seed=self._seeds, options=options or None)
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [row_of(infos, number) for number in range(self.num_envs)]
        return seen

    def step_async(self, actions: Array) -> None:
        """Keep the actions for ``step_wait``."""
        self._actions = actions

    def step_wait(self) -> tuple[Observation, Array, Array, list[dict[str, Any]]]:
        """Take the actions; the last observation of an ended episode is ``terminal_observation`` of its info."""
        seen, rewards, terminated, truncated, infos = self.envs.step(self._actions)
        rows = [row_of(infos, number) for number in range(self.num_envs)]
        for number in np.flatnonzero(terminated | truncated).tolist():
            final = row_of(infos["final_info"], number)
            over = bool(truncated[number] and not terminated[number])
            rows[number] = final | {"terminal_observation": infos["final_obs"][number], "TimeLimit.truncated": over}
        return seen, rewards.astype(np.float32), terminated | truncated, rows

    def close(self) -> None:
        """Close the environments."""
        self.envs.close()

    def get_images(self) -> Sequence[Array | None]:
        """Return what each agent sees now."""
        images: tuple[Array, ...] | None = self.envs.render()  # type: ignore[assignment]  # persist's own
        return images or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return an attribute of the vector environment, once for each of the environments."""
        return [getattr(self.envs, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Refuse: the environments of one batch have no attributes of their own."""
        raise PersistError(f"{attr_name}: environments of one batch have no attributes of their own")

    def env_method(self, method_name: str, *arguments: Any, indices: Indices = None, **named: Any) -> list[Any]:
        """Refuse: the environments of one batch have no methods of their own."""
        raise PersistError(f"{method_name}: environments of one batch have no methods of their own")

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Indices = None) -> list[bool]:
        """Return that none is wrapped."""
        return [False] * len(list(self._get_indices(indices)))


class DepthAndGoal(BaseFeaturesExtractor):  # type: ignore[misc]
    """The nearest depth in each of 16 parts of the view, as of a laser scanner, and the goal's place; no colours.

    Args:
        space: of observations with ``observe_goal="place"``, whose images have a multiple of 16 columns.

    Raises:
        PersistError: for other observations.
    """

    def __init__(self, space: spaces.Dict) -> None:
        width, goal = (space[name].shape for name in ("depth", "goal"))
        if goal != (2,) or width is None or width[1] % DEPTH_COLUMNS:
            raise PersistError(
                f"observations with a goal of shape {goal} and depth of shape {width}: take observe_goal='place' and "
                f"images of a multiple of {DEPTH_COLUMNS} columns"
            )
        super().__init__(space, DEPTH_COLUMNS + 2)

    def forward(self, seen: Mapping[str, Tensor]) -> Float[Tensor, "batch 18"]:
        """Return depths and place over 5 m."""
        upper = seen["depth"][:, : seen["depth"].shape[1] // 2]  # below, the floor is the nearest
        upper = torch.where(upper > 0, upper, FARTHEST)  # 0 is missing, as the sky is
        nearest = upper.amin(1).unflatten(1, (DEPTH_COLUMNS, -1)).amin(2)
        return torch.cat([nearest, seen["goal"]], dim=1) / USUAL_METRES


def success_rate(model: Any, envs: VectorEnv[Observation, Array, Array], episodes: int, seed: int = 0) -> float:
    """Return the share of episodes in which a model of stable-baselines3, acting at random, reaches its goal.

    Args:
        model: the model.
        envs: where it acts.
        episodes: number of episodes.
        seed: of the first environment's episodes; equal seeds draw equal starts and goals.
    """
    stepped = VecMonitor(BatchedVecEnv(envs))
    stepped.seed(seed)
    ends: list[bool] = []

    def note(names: dict[str, Any], _: dict[str, Any]) -> None:
        if names["done"]:
            ends.append(bool(names["info"]["is_success"]))

    evaluate_policy(model, stepped, episodes, deterministic=False, callback=note)
    return sum(ends) / len(ends)


def row_of(infos: dict[str, Any], number: int) -> dict[str, Any]:
    """Return the info of one environment out of those of a vector environment, without final ones."""
    names = [name for name in infos if not name.startswith(("_", "final_"))]
    return {name: infos[name][number].item() for name in names if infos[f"_{name}"][number]}
