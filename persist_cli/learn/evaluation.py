"""How well a policy finds its way in the true scene: episodes in closed loop, without any model."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import torch

from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.api.policy import Goal, Policy
from persist_cli.api.simulator import Simulator
from persist_cli.episodes.episodes import Episode, EpisodeSet, read_episodes
from persist_cli.episodes.navigator import Navigator, PlanSettings, RowParts
from persist_cli.episodes.rows import PlanningRow
from persist_cli.episodes.run_episode import LoopSettings, run_closed_loop
from persist_cli.episodes.stop_rules import StopByCost, StopRule
from persist_cli.episodes.true_scene import TrueScene
from persist_cli.errors import DataError, PersistError
from persist_cli.io.settings import parse_settings
from persist_cli.output.console import watched
from persist_cli.plugins import load_plugin, make_cost

# shown the goal image, given nothing else
ROW = PlanningRow(name="policy", planner="policy", policy=None, memory=None, goal="image", walk=False)

# of 0.05 to 0.3: most success of the packaged policy in 124 episodes of 10 validation houses
STOP_COST: Final = 0.17  # LPIPS


class NeverStops:
    """The rule of an agent that stops when its policy proposes nothing, and never else."""

    def stops(self, view: Observations, goal: Goal, world_up: Sequence[float]) -> bool:
        """Return false."""
        return False


def episodes_of(file: Path, info: TrajectoryInfo, simulator: Simulator) -> list[Episode]:
    """Return the episodes of a file that are in the scene of the views.

    Args:
        file: of episodes.
        info: of the views.
        simulator: of the views, in which the episodes are run.

    Raises:
        DataError: when there is none, or their simulator is another one or has another agent.
    """
    read = read_episodes(file)
    check_agent(file, read, simulator)
    found = [episode for episode in read.episodes if episode.scene_name == info.scene]
    if not found:
        raise DataError(
            f"{file}: no episode in scene {info.scene!r}, which the views show; draw some with its --scenes"
        )
    return found


def check_agent(file: Path, episodes: EpisodeSet, simulator: Simulator) -> None:
    """Raise ``DataError`` when the agent of some episodes is another than that of the views' simulator."""
    if episodes.simulator != simulator.name:
        raise DataError(f"{file}: episodes of simulator {episodes.simulator!r}, the views are of {simulator.name!r}")
    drawn = asdict(parse_settings(load_plugin("simulator", simulator.name).settings_type, episodes.settings, str(file)))
    ours = asdict(simulator.settings)
    other = [name for name in drawn if drawn[name] != ours[name]]
    if other:
        theirs, own = (" and ".join(f"{name} {values[name]}" for name in other) for values in (drawn, ours))
        raise DataError(
            f"{file}: episodes with {theirs}, the views were collected with {own}; give them to `bench episodes`"
        )


def stop_rule(cost: float) -> StopRule:
    """Return by what an agent knows its goal: a view that is like the goal image, as in ``persist bench plan``.

    Args:
        cost: largest LPIPS-Alex of such a view; at 0 nothing is compared.

    Raises:
        PersistError: when the weights of LPIPS are missing.
    """
    if not cost:
        return NeverStops()
    measure = make_cost("lpips", {})
    if missing := measure.missing():
        raise PersistError(f"--stop-cost: {missing}; or --stop-cost 0, to stop only where the policy does")
    return StopByCost(measure, cost)


def evaluate_policy(
    policy: Policy, simulator: Simulator, episodes: Sequence[Episode], stop: StopRule, loop: LoopSettings
) -> Iterator[dict[str, Any]]:
    """Yield what happened in each episode as JSON values, as ``persist bench plan`` keeps it.

    Args:
        policy: acts alone; it also stops where it proposes nothing.
        simulator: of the episodes.
        episodes: in any scenes of it.
        stop: rule by which the agent stops.
        loop: actions between decisions, and patience.
    """
    parts, planning = RowParts(policy=policy), PlanSettings(horizon=policy.longest or PlanSettings().horizon)
    for episode in watched(episodes, "evaluating", "episodes"):
        scene = TrueScene(simulator, episode)
        with torch.no_grad():
            navigator = Navigator(ROW, parts, planning, scene, planning.horizon)
            record = run_closed_loop(scene, navigator, stop, loop)
        yield {"episode": episode.name, **record}


def mean_figures(records: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Return the mean of each figure over the episodes that have it finite; JSON has ``None`` for those that do not."""
    means = {}
    for name in records[0]["figures"]:
        figures = [one["figures"][name] for one in records]
        values = torch.tensor([math.nan if one is None else one for one in figures], dtype=torch.float64)
        means[name] = float(values[values.isfinite()].mean())
    return means
