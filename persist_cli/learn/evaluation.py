"""How well a policy finds its way in the true scene: episodes in closed loop, without any model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import torch

from persist_cli.api.observations import Observations
from persist_cli.api.policy import Goal, Policy
from persist_cli.api.simulator import Simulator
from persist_cli.bench.episodes import Episode
from persist_cli.bench.navigator import Navigator, PlanSettings, RowParts
from persist_cli.bench.rows import PlanningRow
from persist_cli.bench.run_episode import LoopSettings, run_closed_loop
from persist_cli.bench.true_scene import TrueScene
from persist_cli.policies.open_policy import open_policy
from persist_cli.viewing.console import watched

ROW = PlanningRow("policy", "policy", None, None, "image", False)  # shown the goal image, given nothing else


STOP: Final = 4.0  # of 1.5 to 12: most success of the packaged policy in 124 episodes of 10 validation houses


class StopsItself:
    """The rule of an agent that stops when its policy proposes nothing, and never else."""

    def stops(self, view: Observations, goal: Goal, world_up: Sequence[float]) -> bool:
        """Return false."""
        return False


def stopping_policy(folder: str, stop: float) -> Policy:
    """Return a trained policy; where it predicts how far its goal is, with the distance up to which it stops.

    Args:
        folder: run or folder of the policy.
        stop: spacings of frames. In plans an agent has another rule to stop by; alone, a policy that hardly ever stops
            hardly ever succeeds.
    """
    policy = open_policy(folder)
    return open_policy(folder, {"stop": stop}) if hasattr(policy.settings, "stop") else policy


def evaluate_policy(
    policy: Policy, simulator: Simulator, episodes: Sequence[Episode], loop: LoopSettings
) -> list[dict[str, Any]]:
    """Return what happened in each episode as JSON values, as ``persist bench plan`` keeps it.

    Args:
        policy: acts alone; it stops where it proposes nothing.
        simulator: of the episodes.
        episodes: in any scenes of it.
        loop: actions between decisions, and patience.
    """
    parts, planning = RowParts(policy=policy), PlanSettings(horizon=policy.longest or PlanSettings().horizon)
    records = []
    for episode in watched(episodes, "evaluating", "episodes"):
        scene = TrueScene(simulator, episode)
        with torch.no_grad():
            navigator = Navigator(ROW, parts, planning, scene, planning.horizon)
            record = run_closed_loop(scene, navigator, StopsItself(), loop)
        records.append({"episode": episode.name, **record})
    return records


def mean_figures(records: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Return the mean of each figure over the episodes that have it finite."""
    names = list(records[0]["figures"])
    values = {name: torch.tensor([one["figures"][name] for one in records], dtype=torch.float64) for name in names}
    return {name: float(value[value.isfinite()].mean()) for name, value in values.items()}
