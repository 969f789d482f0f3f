"""Practice walks: a policy acts inside the model, or in the true scene, and what it saw becomes trajectories.

Practice has no teacher. Of several proposals that one is done whose way leads nearest to the goal, by poses and by the
ground that the given views and the walk itself show, the same with every memory. Whatever a walk reached serves as its
goal afterwards (hindsight relabelling): training draws the goal of a sample from the later frames of the same walk, so
that also a walk that missed its goal shows a way to somewhere. Of what it only came to by wandering about the policy
learns the distance, not the way.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import torch
from pydantic import Field

from persist_cli.api.ground import Body, GroundMap
from persist_cli.api.observations import Frame, Observations, TrajectoryInfo
from persist_cli.api.policy import Goal, Policy, Situation
from persist_cli.episodes.stop_rules import AT_PLACE
from persist_cli.learn.places import PracticePlace
from persist_cli.navigation.ground_mapper import GroundMapper
from persist_cli.planning.futures import PoseFutures
from persist_cli.planning.judge import Judge
from persist_cli.plugins import make_cost
from persist_cli.rollout.seeds import SEEDS


@dataclass(frozen=True, kw_only=True)
class PracticeSettings:
    """How a policy practises.

    Args:
        walks: number of walks in a round.
        actions: actions of a walk.
        execute: actions of a proposal that are done before the policy proposes again.
        explore: share of proposals that are random instead.
        batch: walks imagined together.
        proposals: of each decision. Of several the one that comes nearest to the goal's place is done as far as there,
            and a goal that is reached is followed by another one.
    """

    walks: Annotated[int, Field(ge=1)] = 32
    actions: Annotated[int, Field(ge=1)] = 32
    execute: Annotated[int, Field(ge=1)] = 8
    explore: Annotated[float, Field(ge=0, le=1)] = 0.2
    batch: Annotated[int, Field(ge=1)] = 16
    proposals: Annotated[int, Field(ge=1)] = 16


@dataclass(frozen=True)
class PracticeWalk:
    """One walk, without the actions that something blocked.

    Args:
        seen: the given frame at which it begins, and the frame after each action.
        actions: between these frames.
        blocked: number of actions that were blocked.
        goals: number of goals that it was given; a new one each time the policy stops, or reaches it.
    """

    seen: Observations
    actions: tuple[str, ...]
    blocked: int
    goals: int

    def frames(self) -> Iterator[Frame]:
        """Yield its frames, one second after another."""
        poses = self.seen.cameras.world_from_camera.double().numpy()
        for number, action in enumerate([*self.actions, None]):
            rgb, depth = self.seen.rgb[number].numpy(), self.seen.depth[number].numpy()
            yield Frame(rgb, depth, poses[number], action, float(number))


def practise(
    place: PracticePlace,
    policies: tuple[Policy, Policy],
    views: Observations,
    settings: PracticeSettings,
    seed: int,
    done: int = 0,
) -> Iterator[PracticeWalk]:
    """Yield walks from random given frames towards the views of others.

    Args:
        place: where the policy acts.
        policies: the one that practises, and the one that proposes where it explores.
        views: the given posed frames.
        settings: of the practice.
        seed: of all that is random.
        done: number of the first walks that are left out, in whole batches; the others are as if they were not.
    """
    shown = ground_of(views, place)
    for first in range(done, settings.walks, settings.batch):
        numbers = range(first, min(first + settings.batch, settings.walks))
        walkers = [Walker(place, policies, views, shown, settings, seed * SEEDS + number) for number in numbers]
        place.begin([walker.seen for walker in walkers], [walker.sampling_seed for walker in walkers])
        while going := [number for number, walker in enumerate(walkers) if not walker.is_done]:
            ways = {number: walkers[number].decide() for number in going}
            for number, result in place.act(ways).items():
                walkers[number].saw(ways[number], result.seen, result.free.tolist())
        yield from (walker.walk() for walker in walkers)


def ground_of(views: Observations, place: PracticePlace) -> GroundMapper | None:
    """Return the ground that the given views show; ``None`` where nothing stops an agent."""
    if place.body is None:
        return None
    mapper = GroundMapper(place.info.world_up, place.body)
    mapper.add(views)
    return mapper


class Walker:
    """One walk while it goes on.

    Args:
        place: where it walks.
        policies: as of ``practise``.
        views: the given frames.
        ground: that they show; ``None`` where nothing stops an agent.
        settings: of the practice.
        seed: of its start, goals and proposals.
    """

    def __init__(
        self,
        place: PracticePlace,
        policies: tuple[Policy, Policy],
        views: Observations,
        ground: GroundMapper | None,
        settings: PracticeSettings,
        seed: int,
    ) -> None:
        self.mapper = None if ground is None else ground.copy()
        self.info, self.body, self.views, self.settings = place.info, place.body, views, settings
        self.policy, self.explorer = policies
        self.cost = make_cost("geodesic", {}).fitted(self.body or Body())
        self.random = np.random.default_rng(seed)
        self.generator = torch.Generator().manual_seed(int(self.random.integers(2**62)))
        self.sampling_seed = int(self.random.integers(SEEDS))
        start = int(self.random.integers(len(views)))
        self.seen = views[[start]]
        self.actions: list[str] = []
        self.taken = self.blocked = self.goals = 0
        self._new_goal()

    @property
    def is_done(self) -> bool:
        """Whether it has done its actions."""
        return self.taken >= self.settings.actions

    def decide(self) -> tuple[str, ...]:
        """Return its next actions, at least one while it is not done; where the policy stops, another goal is drawn."""
        ground = GroundMap.empty(self.info.world_up) if self.mapper is None else self.mapper.map()
        situation = Situation(self.seen[-self.policy.frames :], self.info, self.goal, ground)
        horizon = min(self.settings.execute, self.policy.longest or self.settings.execute)
        if self.random.random() < self.settings.explore:
            way = self.explorer.proposals(situation, horizon, 1, self.generator)[0]
        else:
            proposed = self.policy.proposals(situation, horizon, self.settings.proposals, self.generator)
            way = self._chosen(proposed, ground)
        if not way:
            self._new_goal()
            way = self.explorer.proposals(situation, horizon, 1, self.generator)[0]
        return tuple(way[: min(horizon, self.settings.actions - self.taken)])

    def _chosen(self, ways: Sequence[tuple[str, ...]], ground: GroundMap) -> tuple[str, ...]:
        """Return the only way, or the one that comes nearest to the goal, as far as there; none at the goal."""
        if len(ways) == 1 or not all(ways):
            return ways[0]
        now, goal = self.seen.cameras[-1:], self.goal.position
        assert goal is not None
        if float(ground.places(goal - now.centers[0]).norm()) <= AT_PLACE:
            return ()
        judge = Judge(PoseFutures(now, self.info, ground, self.body), self.cost, self.goal, ground, "best")
        nearest = min(judge.judge(ways, 1), key=lambda one: one.cost)
        return nearest.actions[: nearest.best]  # with those that are blocked, as a policy does them

    def saw(self, way: Sequence[str], seen: Observations, free: Sequence[bool]) -> None:
        """Take in the frame after each action; of a blocked one nothing is kept but the count."""
        moved = [number for number, is_free in enumerate(free) if is_free]
        self.taken, self.blocked = self.taken + len(way), self.blocked + len(way) - len(moved)
        if moved:
            self.seen = Observations.concatenate([self.seen, seen[moved]])
            if self.mapper is not None:
                self.mapper.add(seen[moved])
            self.actions += [way[number] for number in moved]

    def walk(self) -> PracticeWalk:
        """Return the walk."""
        return PracticeWalk(self.seen, tuple(self.actions), self.blocked, self.goals)

    def _new_goal(self) -> None:
        view = self.views[[int(self.random.integers(len(self.views)))]]
        self.goal = Goal(view.rgb[0], view.cameras.centers[0].double(), self.info.scene)
        self.goals += 1


def info_of_walks(info: TrajectoryInfo, place: PracticePlace) -> TrajectoryInfo:
    """Return the info of walks, whose source says where they were walked."""
    return replace(info, source={**info.source, "practice": place.origin})
