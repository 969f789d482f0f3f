"""The classical policy: the shortest way over the ground that is known to be free; it learns and imagines nothing.

For example the goal's place lies in the next room, which the map shows: it goes there by the shortest way. Where the
map does not show it, or the goal is only an image, it goes to the frontier, where free ground borders on unknown ground
(Yamauchi 1997), and so explores.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from persist_cli.api.actions import Action
from persist_cli.api.ground import Cover, GroundMap
from persist_cli.api.policy import Policy, Situation
from persist_cli.navigation.ground_mapper import body_of
from persist_cli.navigation.routes import Distances, distances_to, walkable
from persist_cli.navigation.ways import way_is_free
from persist_cli.policies.simple import gait

LOOK_AHEAD: Final = 3  # steps straight ahead that are compared before the next one
TURN_COST: Final = 0.02  # metres that a turn counts where two ways are about as long
PATIENCE: Final = 4  # steps that may bring the agent no nearer
IN_VIEW: Final = 25.0  # degrees to each side in which an agent has looked already
NEARBY: Final = 0.5  # metres of unknown ground that is looked at together
PATCH: Final = 0.5  # metres of the patches that are made longer at random for other ways

Place = Float[Tensor, " 2"]


@dataclass(frozen=True)
class ShortestPathSettings:
    """When it stops, what it takes for a frontier, and how much its proposals differ.

    Args:
        near: metres from the goal's place at which it stops.
        frontier: metres that a frontier has at least; shorter ones are holes between pixels.
        variety: how much longer, as a share, patches of ground are made at random for every proposal but the first.
    """

    near: float = 0.3
    frontier: float = 0.4
    variety: float = 1.0

    def __post_init__(self) -> None:
        for name in ("near", "frontier", "variety"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} {getattr(self, name)} must be at least 0 and finite")


@dataclass(frozen=True)
class Target:
    """Where to go: some squares' places, and for a frontier the unknown ground beyond it.

    Args:
        places: on the ground axes, metres.
        beyond: of the unknown squares there; ``None`` at a goal.
    """

    places: Float[Tensor, "place 2"]
    beyond: Float[Tensor, "unknown 2"] | None = None

    def sight(self, place: Place) -> Place:
        """Return the place to look at from a place beside the target: the middle of what is unknown nearby."""
        squares = self.places if self.beyond is None else self.beyond
        apart = (squares - place).norm(dim=1)
        return squares[apart <= apart.min() + NEARBY].mean(0)


class ShortestPathPolicy(Policy):
    """Goes to the goal's place by the shortest known way, else to the frontier that costs the fewest actions.

    A frontier costs the actions to it and, where the goal's place is known, those of the straight line from there. The
    first proposal is the best way. Others go to the goal over ground whose patches are made longer at random, or to the
    next frontiers. Without any known ground it turns on the spot; where all is seen and the goal is not, it stops.
    """

    settings_type = ShortestPathSettings
    settings: ShortestPathSettings

    def propose(
        self, situation: Situation, horizon: int, count: int, generator: torch.Generator
    ) -> list[tuple[str, ...]]:
        """Return ``count`` sequences of at most ``horizon`` actions, which end at the goal or frontier.

        Raises:
            PersistError: when the vocabulary has no step ahead or no turn.
        """
        walker = Walker(situation)
        if self._arrived(situation, walker):
            return [()] * count
        if not bool((situation.ground.states == Cover.FREE).any()):
            return [(walker.turns[0].name,) * horizon] * count
        targets = self._targets(situation, walker)
        if not targets:
            return [()] * count
        chosen = [(targets[number % len(targets)], self._costs(number, walker, generator)) for number in range(count)]
        return [walker.go(target, costs, horizon, self.settings.near) for target, costs in chosen]

    def _arrived(self, situation: Situation, walker: Walker) -> bool:
        goal = situation.goal.position
        return goal is not None and float((walker.ground.places(goal) - walker.place).norm()) <= self.settings.near

    def _targets(self, situation: Situation, walker: Walker) -> list[Target]:
        """The goal where a way to it is known, else the frontiers, the cheapest first."""
        goal = None if situation.goal.position is None else walker.ground.places(situation.goal.position)
        if goal is not None:
            target = Target(goal[None])
            if math.isfinite(float(walker.distances(target).at(walker.place[None])[0])):
                return [target]
        from_agent = distances_to(walker.ground, walker.place[None], walker.radius)
        rated: list[tuple[float, int, Target]] = []
        for frontier in frontiers(walker.ground, walker.radius, self.settings.frontier):
            metres = from_agent.at(frontier.places)
            nearest = int(metres.argmin())
            if math.isinf(float(metres[nearest])) or walker.has_looked_at(frontier, float(metres[nearest])):
                continue
            onward = 0.0 if goal is None else float((frontier.places[nearest] - goal).norm())
            rated.append((walker.actions_for(float(metres[nearest]) + onward, frontier), len(rated), frontier))
        return [frontier for *_, frontier in sorted(rated, key=lambda item: item[:2])]

    def _costs(self, number: int, walker: Walker, generator: torch.Generator) -> Float[Tensor, "row column"] | None:
        """Factors of the ground for a proposal, ``None`` for the first."""
        if number == 0 or not self.settings.variety:
            return None
        rows, columns = walker.ground.states.shape
        patches = [max(2, math.ceil(side * walker.ground.spacing / PATCH)) for side in (rows, columns)]
        drawn = torch.rand(1, 1, *patches, generator=generator, dtype=torch.float64)
        smooth = functional.interpolate(drawn, (rows, columns), mode="bilinear", align_corners=True)[0, 0]
        return 1 + self.settings.variety * smooth


class Walker:
    """Turns ways over the ground into actions, from where the agent stands.

    Args:
        situation: ground, pose and vocabulary.
    """

    def __init__(self, situation: Situation) -> None:
        self.ground, self.info = situation.ground, situation.info
        self.radius = body_of(situation.info).radius
        self.ahead, self.turns = gait(situation.info.vocabulary)
        pose = situation.seen.cameras.world_from_camera[-1].cpu().double()
        self.place: Place = self.ground.places(pose[:3, 3])
        x, y = (self.ground.axes[:2] @ pose[:3, 2]).tolist()
        self.heading = math.degrees(math.atan2(y, x))  # degrees to the left of the first ground axis

    def distances(self, target: Target, costs: Float[Tensor, "row column"] | None = None) -> Distances:
        """Return the metres from everywhere to a target."""
        return distances_to(self.ground, target.places, self.radius, costs=costs)

    def actions_for(self, metres: float, target: Target) -> float:
        """Return about how many actions a way of some metres takes, with the turns to look at where it leads."""
        turns = abs(self.angle_to(target.sight(self.place))) / abs(self.turns[0].turn)
        return metres / self.ahead.forward + turns

    def angle_to(self, place: Place) -> float:
        """Return the degrees to the left by which a place lies beside the heading, -180 to 180."""
        x, y = (place - self.place).tolist()
        return wrapped(math.degrees(math.atan2(y, x)) - self.heading)

    def has_looked_at(self, frontier: Target, metres: float) -> bool:
        """Return whether the agent stands at a frontier and looks beyond it, so that there is no more to see."""
        return metres < self.ahead.forward and abs(self.angle_to(frontier.sight(self.place))) < IN_VIEW

    def go(
        self, target: Target, costs: Float[Tensor, "row column"] | None, horizon: int, near: float
    ) -> tuple[str, ...]:
        """Return the actions of the way to a target, at most ``horizon``.

        Args:
            target: where to go.
            costs: factors of the ground, as of ``distances_to``.
            horizon: largest number of actions.
            near: metres at which a goal is reached; a frontier is reached within a step.
        """
        distances, place, heading = self.distances(target, costs), self.place, self.heading
        reached = near if target.beyond is None else self.ahead.forward
        names: list[str] = []
        best, patience = math.inf, 0
        while len(names) < horizon and patience < PATIENCE:
            left = float(distances.at(place[None])[0])
            best, patience = (left, 0) if left < best - 1e-9 else (best, patience + 1)
            turns = None if left <= reached else self._best_turns(distances, place, heading)
            if turns is None:
                break
            names += [*turns, self.ahead.name]
            heading += self._turned(turns)
            place = place + self.ahead.forward * direction(heading)
        if target.beyond is not None:
            x, y = (target.sight(place) - place).tolist()
            names += self._turns_by(wrapped(math.degrees(math.atan2(y, x)) - heading))
        return tuple(names[:horizon])

    def _best_turns(self, distances: Distances, place: Place, heading: float) -> list[str] | None:
        """The turns towards the straight way whose first steps lead nearest to the target; ``None`` if none is free."""
        options = list(self.options())
        angles = [heading + self._turned(turns) for turns in options]
        ways = torch.stack([direction(angle) for angle in angles]) * self.ahead.forward
        steps = torch.arange(1, LOOK_AHEAD + 1, dtype=torch.float64)
        ends = place + steps[:, None, None] * ways  # [step, option, 2]
        starts = place + (steps - 1)[:, None, None] * ways
        covers = way_is_free(self.ground, starts.flatten(0, 1), ends.flatten(0, 1), self.radius)
        free = (covers != Cover.OCCUPIED).reshape(len(steps), -1).cumprod(0).bool()
        metres = distances.at(ends) + self.ahead.forward * steps[:, None]
        effort = torch.tensor([TURN_COST * len(turns) for turns in options], dtype=torch.float64)
        cost, number = torch.where(free, metres + effort, math.inf).amin(0).min(0)
        return options[int(number)] if math.isfinite(float(cost)) else None

    def options(self) -> Iterator[list[str]]:
        """All turns on the spot that lead to different headings, the shortest first."""
        yield []
        whole = 360 if len(self.turns) == 1 else 180
        most = max(int(whole // abs(turn.turn)) for turn in self.turns)
        for count in range(1, most + 1):
            for turn in self.turns:
                if count * abs(turn.turn) <= whole and count * abs(turn.turn) < 360:
                    yield [turn.name] * count

    def _turns_by(self, degrees: float) -> list[str]:
        """The turns that come nearest to an angle."""
        return min(self.options(), key=lambda turns: abs(wrapped(self._turned(turns) - degrees)))

    def _turned(self, turns: list[str]) -> float:
        """Degrees to the left of some turns of one kind."""
        return sum(self._turn(name).turn for name in turns)

    def _turn(self, name: str) -> Action:
        return self.info.vocabulary[name]


def frontiers(ground: GroundMap, radius: float, least: float) -> list[Target]:
    """Return the frontiers of a map: connected walkable squares that border on unknown ground.

    Args:
        ground: the map; what lies outside of it is unknown.
        radius: metres of the body that shall stand there.
        least: metres that a frontier has at least.
    """
    from scipy import ndimage

    padded = functional.pad(ground.states, (1, 1, 1, 1), value=int(Cover.UNKNOWN))
    unknown = padded == Cover.UNKNOWN
    border = walkable(ground, radius) & grown(unknown)[1:-1, 1:-1]
    labels, count = ndimage.label(border.numpy(), structure=np.ones((3, 3)))
    found = []
    for number in range(1, count + 1):
        squares = torch.from_numpy(labels == number)
        if int(squares.sum()) * ground.spacing >= least:
            beyond = grown(functional.pad(squares, (1, 1, 1, 1))) & unknown
            found.append(Target(middles(ground, squares), middles(ground, beyond, 1)))
    return found


def grown(squares: Bool[Tensor, "row column"]) -> Bool[Tensor, "row column"]:
    """Return the squares with all their eight neighbours."""
    return functional.max_pool2d(squares[None, None].float(), 3, 1, 1)[0, 0] > 0


def middles(ground: GroundMap, squares: Bool[Tensor, "row column"], border: int = 0) -> Float[Tensor, "square 2"]:
    """Return the places of the middles of squares; ``border`` squares were added around the map."""
    numbers = squares.nonzero().flip(1).double() - border + 0.5
    return numbers * ground.spacing + torch.tensor(ground.origin, dtype=torch.float64)


def direction(degrees: float) -> Place:
    """Return the unit vector on the ground axes of a heading in degrees to the left."""
    angle = math.radians(degrees)
    return torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)


def wrapped(degrees: float) -> float:
    """Return an angle within -180 to 180 degrees."""
    return (degrees + 180) % 360 - 180
