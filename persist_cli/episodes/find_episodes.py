"""Episodes are drawn from held-out scenes: goals at so many actions from a start, in sight of it and not."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch

from persist_cli.api.actions import format_actions
from persist_cli.api.geometry import in_view
from persist_cli.api.observations import Observations
from persist_cli.api.simulator import Simulator, Stand, random_ground
from persist_cli.episodes.episodes import SIGHT_SHARE, Episode, GivenWalk
from persist_cli.episodes.shortest_actions import ShortestActions
from persist_cli.episodes.true_scene import look_from, observations_of, stand
from persist_cli.errors import DataError, hint
from persist_cli.evaluate.coverage import seen_share
from persist_cli.simulators.free_grid import FreeGrid, Geodesic
from persist_cli.simulators.policies import go_to
from persist_cli.simulators.way_back import Key, Pose

NEAREST_GOAL = 1.25  # metres from the start, farther than the distance that counts as success

STARTS = 4  # that are tried in each scene

GOALS = 24  # that are looked at for each kind from each start

BELOW = (0.0, 0.5, 1.0)  # metres under the goal's camera at which it is looked for

SIGHTS: Final = {"both": (True, False), "in-sight": (True,), "hidden": (False,)}

Kind = tuple[int, bool]  # the bin, and whether the goal is in sight


@dataclass(frozen=True, kw_only=True)
class EpisodeSearch:
    """Which episodes are wanted.

    Args:
        bins: numbers of actions of the shortest ways.
        each: most episodes of each bin, as many in sight and out of sight.
        walk_frames: most frames of the given walk.
        seed: seed of starts and goals.
        per_scene: most episodes of each of these kinds in one scene.
        goal_gap: metres around the goal from which no frame of the walk is given.
        goals: ``in-sight`` or ``hidden`` for these alone, else ``both``.
    """

    bins: Sequence[int] = (8, 16, 32, 64)
    each: int = 16
    walk_frames: int = 48
    seed: int = 0
    per_scene: int = 1
    goal_gap: float = 0.0
    goals: str = "both"

    def check(self) -> None:
        """Raise ``DataError`` for a bin, a number or a seed that cannot be."""
        if not self.bins or min(self.bins) < 1:
            raise DataError(f"--bins {','.join(map(str, self.bins))}: name numbers of actions above 0, as in 8,16")
        if min(self.each, self.walk_frames, self.per_scene) < 1 or self.seed < 0:
            raise DataError(
                f"{self.each} episodes of a kind, {self.per_scene} in a scene, with {self.walk_frames} frames and seed "
                f"{self.seed}: the first three must be at least 1, the seed not negative"
            )
        if not 0 <= self.goal_gap < math.inf:
            raise DataError(f"--goal-gap {self.goal_gap:g}: give metres, 0 for none")
        if self.goals not in SIGHTS:
            raise DataError(f"unknown --goals {self.goals!r}; {hint(self.goals, SIGHTS)}")

    @property
    def kinds(self) -> list[Kind]:
        """All kinds of episodes that are sought, without repeats."""
        return [(number, sight) for number in sorted(set(self.bins)) for sight in SIGHTS[self.goals]]


def find_episodes(simulator: Simulator, scenes: Sequence[int], search: EpisodeSearch) -> Iterator[list[Episode]]:
    """Yield the episodes of each scene, until there are enough of every kind.

    They depend on the seed and on the scenes before, not on the process or the machine.
    """
    counts: Counter[Kind] = Counter()
    for scene in scenes:
        if all(counts[kind] >= search.each for kind in search.kinds):
            return
        in_scene, found = SceneSearch(simulator, scene, search), list[Episode]()
        for turn in range(search.per_scene):
            new = in_scene.find([kind for kind in search.kinds if counts[kind] < search.each], turn)
            counts.update((episode.bin, episode.in_sight) for episode in new)
            found += new
        yield found


class SceneSearch:
    """The search for episodes in one scene, which it opens."""

    def __init__(self, simulator: Simulator, scene: int, search: EpisodeSearch) -> None:
        self.simulator, self.scene, self.search = simulator, scene, search
        self.random = np.random.default_rng([search.seed, scene])
        simulator.open_scene(scene)
        self.grid = FreeGrid(simulator)
        self.suffix = ""  # of the names of the episodes that are found now

    def find(self, wanted: Sequence[Kind], turn: int = 0) -> list[Episode]:
        """Return an episode of each wanted kind that the scene has, shorter ways first.

        Args:
            wanted: the kinds.
            turn: how often this scene was searched before; names say it.
        """
        self.suffix = f"-{turn}" if turn else ""
        found: dict[Kind, Episode] = {}
        for _ in range(STARTS):
            missing = [kind for kind in wanted if kind not in found]
            ground = random_ground(self.simulator, self.random)
            if not missing or ground is None:
                break
            heading = float(self.random.uniform(-math.pi, math.pi))
            found |= self._from(Stand(ground=ground, heading=heading), missing)
        return [found[kind] for kind in sorted(found, key=lambda kind: (kind[0], not kind[1]))]

    def _from(self, start: Stand, missing: Sequence[Kind]) -> dict[Kind, Episode]:
        """The episodes of the missing kinds that begin at a start."""
        view = look_from(self.simulator, start)
        start = _stand_of(self.simulator)  # as exact as the simulator keeps it
        ways = ShortestActions(self.simulator, Pose(start.ground, start.heading), max(number for number, _ in missing))
        found: dict[Kind, Episode] = {}
        for number in sorted({number for number, _ in missing}):
            for key, sight, share in self._goals(ways, number, view):
                kind = number, sight
                if kind in missing and kind not in found:
                    episode = self._episode(start, ways.actions_to(key), kind, share)
                    found |= {} if episode is None else {kind: episode}
        return found

    def _goals(self, ways: ShortestActions, number: int, view: Observations) -> Iterator[tuple[Key, bool, float]]:
        """Some goals at a number of actions, each with whether it is in sight and the share of it that is seen."""
        ground = self.simulator.agent[0]
        far = [key for key, place in ways.arrivals(number) if math.dist(ground, place) >= NEAREST_GOAL]
        for index in self.random.permutation(len(far))[:GOALS]:
            goal = self._arrive(view, ways.actions_to(far[index]))
            if goal is not None:
                share = seen_share(Observations.concatenate([view, goal]), 1, [0]) or 0.0
                yield far[index], share >= SIGHT_SHARE or self._shows_place(view, goal), share

    def _arrive(self, view: Observations, actions: Sequence[str]) -> Observations | None:
        """The frame at the end of some actions from the frame ``view``; ``None`` where the scene refuses one."""
        start = _stand_of(self.simulator)
        arrived = all(map(self.simulator.act, actions))
        goal = observations_of([self.simulator.observe()], self.simulator.info) if arrived else None
        stand(self.simulator, start)
        return goal

    def _shows_place(self, view: Observations, goal: Observations) -> bool:
        """Whether a frame shows a point of the upright line under the goal's camera."""
        up = torch.tensor(self.simulator.info.world_up, dtype=torch.float64)
        points = goal.cameras.centers[0] - torch.tensor(BELOW, dtype=torch.float64)[:, None] * up
        inside, pixels, depth = in_view(points, view.cameras[0], near=0.1)
        columns, rows = pixels[inside].floor().long().unbind(-1)
        surface = view.depth[0, rows, columns].double()
        return bool(((surface == 0) | (depth[inside] <= surface)).any())

    def _episode(self, start: Stand, actions: Sequence[str], kind: Kind, share: float) -> Episode | None:
        """An episode whose agent starts at ``start``; ``None`` where no walk leads from its goal to its start."""
        number, sight = kind
        stand(self.simulator, start)
        all(map(self.simulator.act, actions))
        goal = _stand_of(self.simulator)
        given = self._walk(goal, start)
        stand(self.simulator, start)
        if given is None:
            return None
        return Episode(
            name=f"{self.scene}-{number}-{'in-sight' if sight else 'hidden'}{self.suffix}", scene=self.scene,
            scene_name=self.simulator.info.scene, bin=number, in_sight=sight, goal_share=round(share, 4), start=start,
            goal=goal, actions=format_actions(actions), walk=given, seed=int(self.random.integers(2**31)),
            metres=round(actions.count("forward") * self.simulator.info.vocabulary["forward"].forward, 6),
        )  # fmt: skip

    def _walk(self, goal: Stand, start: Stand) -> GivenWalk | None:
        """The walk from the goal to the start, with a look around.

        ``None`` when it does not come near the start, or what is given of it hardly shows what the goal image shows.
        """
        view = look_from(self.simulator, goal)
        actions, frames, metres = list[str](), [self.simulator.observe()], [0.0]
        for action in self._leave(goal, start):
            actions.append(action)
            frames.append(self.simulator.observe())
            metres.append(math.dist(self.simulator.agent[0], goal.ground))
        far = [number for number, gap in enumerate(metres) if gap >= self.search.goal_gap]
        if not far or Geodesic(self.simulator, start.ground).metres(self.simulator.agent[0]) > NEAREST_GOAL:
            return None
        count = min(self.search.walk_frames, len(far))
        keep = sorted({far[round(place)] for place in np.linspace(0, len(far) - 1, count)})
        seen = observations_of([frames[number] for number in keep], self.simulator.info)
        share = seen_share(Observations.concatenate([seen, view]), len(keep), range(len(keep))) or 0.0
        if self.search.goal_gap and share < SIGHT_SHARE:
            return None
        return GivenWalk(start=goal, actions=format_actions(actions), keep=keep, goal_seen=round(share, 4))

    def _leave(self, goal: Stand, start: Stand) -> Iterator[str]:
        """Go from the goal to the start, look around once the gap is behind, and yield the actions."""
        around = round(360 / self.simulator.info.vocabulary["left"].turn)
        looked = False
        for action in itertools.chain([None], _allowed(go_to(self.simulator, self.grid, start.ground), self.simulator)):
            if action is not None:
                yield action
            if not looked and math.dist(self.simulator.agent[0], goal.ground) >= self.search.goal_gap:
                looked = True
                for _ in range(around):
                    self.simulator.act("left")
                    yield "left"


def _allowed(way: Generator[str, bool, int], simulator: Simulator) -> Iterator[str]:
    """Do the actions of a way, and yield those that the scene allowed."""
    try:
        action = next(way)
        while True:
            allowed = simulator.act(action)
            if allowed:
                yield action
            action = way.send(allowed)
    except StopIteration:
        return


def _stand_of(simulator: Simulator) -> Stand:
    ground, heading = simulator.agent
    return Stand(ground=ground, heading=heading)
