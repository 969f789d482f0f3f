"""What a rule to stop by does: success at several thresholds, and how often a policy comes to its goal at all.

    persist bench episodes --split validation --scenes 0:10 --bins 8,16 --each 40 --per-scene 4 --out runs/episodes.json
    python tests/benchmarks/bench_stopping.py --episodes runs/episodes.json
    python tests/benchmarks/bench_stopping.py --episodes runs/learning/episodes.json \\
        --learned runs/learning/learned/voxel

The policy acts alone and never stops. After each action its view is compared with the goal image (LPIPS), and its
distance to the goal is predicted, so each threshold tells where it would have stopped: by its view or where the policy
does by itself, as ``persist learn`` evaluates, and by the predicted distance alone. ``--set arrive=0 samples=1`` is a
policy that follows the first sampled waypoints to their end. ``--learned`` takes for each house the policy that learned
there (``make learning``), and only houses that have one. Means are over houses; a run without ``--learned`` can be
limited to the same houses by ``--houses``. Prints tables, asserts nothing.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_cli.api.cost import Cost
from persist_cli.api.ground import GroundMap
from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.api.policy import Goal, Situation
from persist_cli.api.simulator import Simulator
from persist_cli.episodes.episodes import Episode, EpisodeSet, read_episodes
from persist_cli.episodes.navigation_metrics import SUCCESS_METRES
from persist_cli.episodes.navigator import Navigator, PlanSettings, RowParts
from persist_cli.episodes.run_episode import ClosedLoop, LoopSettings, Trace
from persist_cli.episodes.stop_rules import view_costs
from persist_cli.episodes.true_scene import TrueScene
from persist_cli.learn.evaluation import ROW
from persist_cli.output.console import print_table, say, watched
from persist_cli.plugins import make_cost, make_simulator
from persist_cli.policies.nomad.policy import STOP, NomadPolicy
from persist_cli.policies.open_policy import open_policy

COSTS = (0.05, 0.1, 0.12, 0.15, 0.17, 0.2, 0.25, 0.3)  # LPIPS
DISTANCES = (1.5, 2, 3, 4, 5, 6, 8)  # spacings of frames


@dataclass
class Recorder:
    """A rule that never stops, and notes of each view what rules to stop by look at.

    Args:
        policy: predicts the distance.
        info: of the scene.
        unlike: LPIPS of each view and the goal image.
        predicted: spacings of frames to the goal, after each view.
    """

    policy: NomadPolicy
    info: TrajectoryInfo
    unlike: list[float] = field(default_factory=list)
    predicted: list[float] = field(default_factory=list)
    seen: Observations | None = None
    cost: Cost = field(default_factory=lambda: make_cost("lpips", {}))  # keeps the features of the goal image

    def stops(self, view: Observations, goal: Goal, world_up: Sequence[float]) -> bool:
        """Take in a view, and return false."""
        past = view if self.seen is None else Observations.concatenate([self.seen, view])
        self.seen = past[-self.policy.frames :]
        self.unlike += view_costs(self.cost, view, goal)
        self.predicted.append(self.policy.distance(Situation(self.seen, self.info, goal, GroundMap.empty(world_up))))
        return False


@dataclass(frozen=True)
class Walk:
    """An episode without a stop.

    Args:
        metres: to the goal, at the start and after each action.
        unlike: LPIPS of the view there and the goal image.
        predicted: distance there.
    """

    metres: list[float]
    unlike: list[float]
    predicted: list[float]

    @property
    def reached(self) -> bool:
        """Whether it was ever near enough to the goal."""
        return min(self.metres) <= SUCCESS_METRES

    def stops(self, unlike: float, predicted: float) -> float | None:
        """Return the metres to the goal where a view is so like it, or a decision finds it so near; else ``None``."""
        looks = zip(self.metres, self.unlike, self.predicted, strict=True)
        each = LoopSettings().execute
        found = (
            metres
            for number, (metres, cost, far) in enumerate(looks)
            if cost <= unlike or (number % each == 0 and far <= predicted)
        )
        return next(found, None)


def walk(policy: NomadPolicy, simulator: Simulator, episode: Episode) -> Walk:
    """Let the policy act until it has no actions left."""
    scene, parts = TrueScene(simulator, episode), RowParts(policy=policy)
    planning = PlanSettings(horizon=policy.longest or 8)
    trace = Trace([scene.distance], [scene.simulator.agent[0]])
    recorder = Recorder(policy, scene.info)
    with torch.no_grad():
        navigator = Navigator(ROW, parts, planning, scene, planning.horizon)
        ClosedLoop(scene, navigator, recorder, LoopSettings(), trace).run()
    return Walk([float(metres) for metres in trace.distances], recorder.unlike, recorder.predicted)


def policies(options: argparse.Namespace, episodes: EpisodeSet) -> Iterator[tuple[str, str]]:
    """Yield the scenes that are measured, each with its policy."""
    for scene in episodes.scenes[: options.houses]:
        folder = None if options.learned is None else options.learned / scene.replace("/", "-")
        if folder is None:
            yield scene, options.policy
        elif (folder / f"round-{options.round:02d}" / "policy").is_dir():
            yield scene, str(folder / f"round-{options.round:02d}" / "policy")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=Path, required=True)
    parser.add_argument("--policy", default="nomad", help="name or folder; the packaged one by default")
    parser.add_argument("--learned", type=Path, help="folder with a learning for each house")
    parser.add_argument("--round", type=int, default=1, help="of these learnings")
    parser.add_argument("--houses", type=int, help="most houses, the first ones")
    parser.add_argument("--set", nargs="+", default=(), help="settings of the policy, as in --set arrive=0 samples=1")
    options = parser.parse_args()
    torch.set_num_threads(1)
    episodes = read_episodes(options.episodes)
    simulator = make_simulator(episodes.simulator, episodes.settings)
    settings = {name: yaml.safe_load(value) for name, value in (text.split("=") for text in options.set)}
    walks: list[list[Walk]] = []
    for scene, text in watched([*policies(options, episodes)], "walking", "houses"):
        policy = open_policy(text, {"stop": 0, **settings})
        assert isinstance(policy, NomadPolicy)
        walks.append([walk(policy, simulator, one) for one in episodes.episodes if one.scene_name == scene])
    report(walks)


def report(walks: Sequence[Sequence[Walk]]) -> None:
    """Print success and wrong stops at each threshold, means over houses."""
    reached = 100 * np.mean([np.mean([one.reached for one in house]) for house in walks])
    near = 100 * np.mean([np.mean(np.concatenate([one.metres for one in house]) <= SUCCESS_METRES) for house in walks])
    episodes = f"{sum(map(len, walks))} episodes of {len(walks)} houses"
    say(f"{episodes}: {reached:.0f} % come to the goal, {near:.0f} % of their frames are there")
    for name, rules in (
        (f"LPIPS, or {STOP:g} predicted", [(cost, STOP) for cost in COSTS]),
        ("predicted alone", [(-1.0, far) for far in DISTANCES]),
    ):
        rows = []
        for unlike, predicted in rules:
            ends = [[one.stops(unlike, predicted) for one in house] for house in walks]
            right = [[metres is not None and metres <= SUCCESS_METRES for metres in house] for house in ends]
            wrong = [[metres is not None and metres > SUCCESS_METRES for metres in house] for house in ends]
            shares = (f"{100 * np.mean([np.mean(house) for house in x]):.0f} %" for x in (right, wrong))
            rows.append([f"{unlike if unlike >= 0 else predicted:g}", *shares])
        print_table("", [name, "success", "wrong stop"], rows)


if __name__ == "__main__":
    main()
