"""What callers give a world model, checked before anything of it changes."""

from __future__ import annotations

from collections.abc import Sequence

from persist_cli.api.observations import Observations, TrajectoryInfo, check_observations
from persist_cli.errors import DataError, PersistError


def check_starts(observations: Sequence[Observations], infos: Sequence[TrajectoryInfo], agents: int) -> None:
    """Check that there is for each agent one frame to begin at, which the model can go on from.

    Args:
        observations: the frames.
        infos: of their trajectories.
        agents: number of agents.

    Raises:
        PersistError: when there are more or fewer than agents.
        DataError: when one is not a single frame, its sizes or types are wrong, or its pose or depth is not finite.
    """
    if not len(observations) == len(infos) == agents:
        raise PersistError(
            f"{agents} agents were given {len(observations)} frames and {len(infos)} infos to begin with; "
            "each needs one of both"
        )
    for number, observation in enumerate(observations):
        where = f"start of agent {number}"
        check_observations(observation, where)
        if len(observation) != 1:
            raise DataError(f"{where}: {len(observation)} frames, where one is wanted, as observations[32:33]")
        if not bool(observation.depth.isfinite().all()) or bool((observation.depth < 0).any()):
            raise DataError(f"{where}: depth is negative or not finite; where it is missing write 0")


def checked_actions(actions: Sequence[Sequence[str]], infos: Sequence[TrajectoryInfo | None]) -> list[tuple[str, ...]]:
    """Return the actions of each agent, all of which it can take.

    Args:
        actions: a list of names for each agent.
        infos: what each agent began with; ``None`` for one that has not begun.

    Raises:
        PersistError: when an agent has not begun, there is not one list for each, or a list is empty.
        DataError: for a name that is not in the agent's vocabulary, and for ``free``.
    """
    if isinstance(actions, str) or any(isinstance(names, str) for names in actions):
        raise PersistError(
            f"actions {actions!r}; give each agent a list of names, as [['forward', 'left']] for a single one"
        )
    lists = [tuple(names) for names in actions]
    if not infos or len(lists) != len(infos) or not all(lists):
        raise PersistError(
            f"{len(infos)} agents were given {len(lists)} lists of {[*map(len, lists)]} actions; "
            "each needs one of at least one action"
        )
    for info, names in zip(infos, lists, strict=True):
        if info is None:
            raise PersistError("the world model has not begun; call reset first")
        for name in dict.fromkeys(names):
            info.vocabulary.motion(name)
    return lists
