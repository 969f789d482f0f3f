"""Several environments of one batch as stable-baselines3 takes them.

For example ``PPO("MultiInputPolicy", VecMonitor(BatchedVecEnv(gymnasium.make_vec("persist/ImaginedHouse-v0", …))))``.
Single environments need none of this: ``PPO("MultiInputPolicy", gymnasium.make("persist/ImaginedHouse-v0", …))``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from persist_cli.environments.task import Array, Observation
from persist_cli.errors import PersistError

Indices = int | Iterable[int] | None


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
        """Begin an episode in each environment, with the seeds of ``seed``."""
        seen, infos = self.envs.reset(seed=self._seeds)
        self._reset_seeds()
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


def row_of(infos: dict[str, Any], number: int) -> dict[str, Any]:
    """Return the info of one environment out of those of a vector environment, without final ones."""
    names = [name for name in infos if not name.startswith(("_", "final_"))]
    return {name: infos[name][number].item() for name in names if infos[f"_{name}"][number]}
