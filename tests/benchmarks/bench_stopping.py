"""What a policy's stop distance does: success at each of several, and how often it comes to its goal at all.

    persist bench episodes --split validation --scenes 0:10 --bins 8,16 --each 40 --per-scene 4 --out runs/episodes.json
    python tests/benchmarks/bench_stopping.py --episodes runs/episodes.json
    python tests/benchmarks/bench_stopping.py --episodes runs/learning/episodes.json \\
        --learned runs/learning/learned/voxel

The policy acts alone and never stops; its predicted distance at each decision says where it would have. ``--learned``
takes for each house the policy that learned there (``make learning``), and only houses that have one. Means are over
houses; a line without ``--learned`` can be limited to the same houses by ``--houses``. Prints a table, asserts nothing.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_cli.api.simulator import Simulator
from persist_cli.bench.episodes import Episode, EpisodeSet, read_episodes
from persist_cli.bench.navigation_metrics import SUCCESS_METRES
from persist_cli.bench.navigator import Navigator, PlanSettings, RowParts
from persist_cli.bench.run_episode import ClosedLoop, LoopSettings, Trace
from persist_cli.bench.true_scene import TrueScene
from persist_cli.learn.evaluation import ROW, StopsItself
from persist_cli.plugins import make_simulator
from persist_cli.policies.nomad.policy import NomadPolicy
from persist_cli.policies.open_policy import open_policy
from persist_cli.viewing.console import print_table, say, watched

STOPS = (1.5, 2, 3, 4, 5, 6, 8)  # spacings of frames


@dataclass(frozen=True)
class Walk:
    """An episode without a stop.

    Args:
        metres: to the goal before each action and after the last.
        predicted: number of actions so far and predicted distance, at each decision.
    """

    metres: list[float]
    predicted: list[tuple[int, float]]

    @property
    def reached(self) -> bool:
        """Whether it was ever near enough to the goal."""
        return min(self.metres) <= SUCCESS_METRES

    def stops(self, distance: float) -> float | None:
        """Return the metres to the goal where it would have stopped, ``None`` where nowhere."""
        return next((self.metres[actions] for actions, far in self.predicted if far <= distance), None)


def walk(policy: NomadPolicy, simulator: Simulator, episode: Episode) -> Walk:
    """Let the policy act until it has no actions left."""
    scene, parts, planning = TrueScene(simulator, episode), RowParts(policy=policy), PlanSettings(policy.longest or 8)
    trace = Trace([scene.distance], [scene.simulator.agent[0]])
    predicted: list[tuple[int, float]] = []

    def note(_module: object, _inputs: object, distance: Tensor) -> None:
        predicted.append((len(trace.actions), float(distance)))

    hook = policy.network.distance.register_forward_hook(note)
    with torch.no_grad():
        navigator = Navigator(ROW, parts, planning, scene, planning.horizon)
        ClosedLoop(scene, navigator, StopsItself(), LoopSettings(), trace).run()
    hook.remove()
    return Walk([float(metres) for metres in trace.distances], predicted)


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
    options = parser.parse_args()
    torch.set_num_threads(1)
    episodes = read_episodes(options.episodes)
    simulator = make_simulator(episodes.simulator, episodes.settings)
    walks: list[list[Walk]] = []
    for scene, text in watched([*policies(options, episodes)], "walking", "houses"):
        policy = open_policy(text, {"stop": 1e-6})  # never, and the distance is predicted
        assert isinstance(policy, NomadPolicy)
        walks.append([walk(policy, simulator, one) for one in episodes.episodes if one.scene_name == scene])
    report(walks)


def report(walks: Sequence[Sequence[Walk]]) -> None:
    """Print success and wrong stops at each distance, means over houses."""
    rows = []
    for distance in STOPS:
        ends = [[one.stops(distance) for one in house] for house in walks]
        right = [[metres is not None and metres <= SUCCESS_METRES for metres in house] for house in ends]
        wrong = [[metres is not None and metres > SUCCESS_METRES for metres in house] for house in ends]
        rows.append(
            [f"{distance:g}", *(f"{100 * np.mean([np.mean(house) for house in x]):.0f} %" for x in (right, wrong))]
        )
    reached = 100 * np.mean([np.mean([one.reached for one in house]) for house in walks])
    near = 100 * np.mean([np.mean(np.concatenate([one.metres for one in house]) <= SUCCESS_METRES) for house in walks])
    episodes = f"{sum(map(len, walks))} episodes of {len(walks)} houses"
    say(f"{episodes}: {reached:.0f} % come to the goal, {near:.0f} % of their frames are there")
    print_table("", ["stop at", "success", "wrong stop"], rows)


if __name__ == "__main__":
    main()
