"""Walks to where a picture was taken, by imagining what is seen at many places.

For example somebody takes the picture of a red chair, goes away and lets the planner walk. It knows the picture alone,
not where it was taken. It imagines the views at places all over the ground that it knows, goes to the one that looks
most like the picture by the shortest way, and there compares short ways until none looks more like it than staying.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import Final, TypeAlias, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from persist_cli.api.cost import Cost, Futures
from persist_cli.api.ground import GroundMap
from persist_cli.api.policy import Goal, Situation
from persist_cli.navigation.routes import distances_to
from persist_cli.planning.approach import best_view, glances, straight_ways
from persist_cli.planning.futures import WorldFutures
from persist_cli.planning.judge import Judge, check_goal
from persist_cli.play.ground import pose_at, turned
from persist_cli.play.settings import GroundPose
from persist_cli.policies.shortest_path import Target, Walker, middles, wrapped
from persist_cli.rollout.world_model import WorldModel

Result = TypeVar("Result")
InParts: TypeAlias = Generator[None, None, Result]  # gives way to others after each part of the work

VIEWS: Final = 24  # of places all over the known ground that are imagined
CLOSER: Final = 12  # of places around the best of these
VIEWS_AT_ONCE: Final = 6  # that are imagined in one part of a decision
WAYS_AT_ONCE: Final = 3  # that are compared in one part
REACH: Final = 8.0  # metres of the shortest way to a place
NEAR: Final = 0.2  # metres at which a place is reached
AROUND: Final = (0.4, 20.0)  # metres and degrees by which the places around the best one differ from it
CHUNK: Final = 16  # actions that are walked before it looks again where it is
STEPS: Final = 6  # actions of the ways that are compared at the end
DECISIONS: Final = 16  # after which it gives up


@dataclass(frozen=True)
class Place:
    """A place on the ground and a heading, as ``GroundPose``, and how unlike the goal the view there looks."""

    pose: GroundPose
    cost: float


class Guide:
    """Decides where to go, a few actions at a time.

    Args:
        goal: a picture.
        cost: says how unlike the picture a view looks.
        seed: of the places that are drawn.

    Raises:
        PersistError: when the weights that compare pictures are missing; the message says how to get them.
    """

    def __init__(self, goal: Goal, cost: Cost, seed: int) -> None:
        self.goal, self._cost = Goal(goal.rgb, None, goal.scene), cost  # not where it was taken
        check_goal(self.goal, self._cost)
        self._generator = torch.Generator().manual_seed(seed)
        self._decisions = 0
        self._decision: InParts[tuple[str, ...]] | None = None  # that is being made
        self._target: GroundPose | None = None
        self._searched = False

    def decide(self, world: WorldModel) -> tuple[str, ...] | None:
        """Return the next actions; none where staying looks most like the picture, or when it gives up.

        A decision is made in parts, so that others get their turn: ``None`` until it is made. It is asked again then,
        with the same world model, unchanged. A part takes half a second on two cores with the reference model.

        Args:
            world: its first agent stands where it decides; the agent is not changed.

        Raises:
            PersistError: when the agent has no step ahead or no turn.
        """
        if self._decision is None:
            self._decisions += 1
            if self._decisions > DECISIONS:
                return ()
            self._decision = self._decide(world)
        try:
            with torch.no_grad():
                next(self._decision)
        except StopIteration as made:
            self._decision = None
            return tuple(made.value)
        return None

    def _decide(self, world: WorldModel) -> InParts[tuple[str, ...]]:
        return (yield from self._on_the_way(world)) or (yield from self._approach(world))

    def _on_the_way(self, world: WorldModel) -> InParts[tuple[str, ...]]:
        """Return actions towards the place whose view looks most like the goal; none there, or where none is known."""
        agent = world.agents[0]
        if agent.surroundings is None:
            return ()
        walker = Walker(Situation(agent.now, agent.info, self.goal, agent.surroundings.map()))
        if not self._searched:
            self._target = yield from self._search(world, walker)
            self._searched = True
        target = self._target
        if target is None:
            return ()
        place = torch.tensor([target.x, target.y], dtype=torch.float64)
        way = walker.go(Target(place[None]), None, CHUNK, NEAR)
        if way:
            return way
        self._target = None
        left = wrapped(target.degrees - walker.heading)
        turns = agent.info.vocabulary
        return tuple(min(walker.options(), key=lambda way: abs(wrapped(sum(turns[name].turn for name in way) - left))))

    def _search(self, world: WorldModel, walker: Walker) -> InParts[GroundPose | None]:
        """Return the place whose imagined view looks most like the goal, ``None`` where no ground can be reached."""
        metres = distances_to(walker.ground, walker.place[None], walker.radius).metres
        places = middles(walker.ground, metres <= REACH)
        if not len(places):
            return None
        numbers = torch.randint(len(places), (VIEWS,), generator=self._generator)
        headings = torch.rand(VIEWS, generator=self._generator, dtype=torch.float64) * 360 - 180
        drawn = torch.cat([places[numbers], headings[:, None]], dim=1)
        best = yield from self._best(world, walker.ground, drawn)
        metres_around, degrees_around = AROUND
        spread = torch.tensor([metres_around, metres_around, degrees_around], dtype=torch.float64)
        center = torch.tensor([best.pose.x, best.pose.y, best.pose.degrees], dtype=torch.float64)
        closer = center + spread * torch.randn(CLOSER, 3, generator=self._generator, dtype=torch.float64)
        closest = yield from self._best(world, walker.ground, closer)
        return min(best, closest, key=lambda place: place.cost).pose

    def _best(self, world: WorldModel, ground: GroundMap, drawn: Float[Tensor, "view 3"]) -> InParts[Place]:
        """Return of some places and headings (metres, metres, degrees) the one whose view looks most like the goal."""
        costs = []
        for part in drawn.split(VIEWS_AT_ONCE):
            costs.append(self._costs(world, ground, part))
            yield
        measured = torch.cat(costs)
        number = int(measured.argmin())
        return Place(GroundPose(*drawn[number].tolist()), float(measured[number]))

    def _costs(self, world: WorldModel, ground: GroundMap, drawn: Float[Tensor, "view 3"]) -> Float[Tensor, " view"]:
        """Return how unlike the goal the views at some places and headings look."""
        now, info = world.agents[0].now.cameras, world.agents[0].info
        start = now.world_from_camera[0]
        poses = [turned(pose_at(start, x, y, info), degrees, info) for x, y, degrees in drawn.tolist()]
        views = world.branches(len(poses))
        length = views.clip_frames - 1
        ways = [now.at(pose.expand(length, 4, 4)) for pose in poses]
        agent = views.agents[0]
        if agent.memory is not None:  # a copy that the views share: one house for all, imagined once
            agent.memory.foresee([views.clip_path(agent, way) for way in ways])
        clips = views.recall(range(len(ways)), ways, [(None,) * length] * len(ways))
        rgb, depth = views.denoise_frame(clips, [length] * len(ways))
        free = torch.ones(len(ways), 1, dtype=torch.bool)
        futures = Futures(rgb[:, None], depth[:, None], torch.stack(poses)[:, None], free)
        return self._cost.measured(futures, self.goal, ground)[:, 0]

    def _approach(self, world: WorldModel) -> InParts[tuple[str, ...]]:
        """Return the actions to the best view on short ways; none where staying looks as good."""
        agent = world.agents[0]
        known = agent.surroundings
        ground = GroundMap.empty(agent.info.world_up) if known is None else known.map()
        judge = Judge(WorldFutures(world, ground, agent.body), self._cost, self.goal, ground, "best")
        stay, ways = glances(agent.info.vocabulary), straight_ways(agent.info.vocabulary, STEPS)
        for first in range(0, len(stay) + len(ways), WAYS_AT_ONCE):
            judge.judge([*stay, *ways][first : first + WAYS_AT_ONCE], 1)  # which remembers them
            yield
        return best_view(judge, stay, ways)
