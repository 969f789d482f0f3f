"""Policies: how an agent walks through a scene: at random, to goals, there and back, round a loop, or to things."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from dataclasses import replace

import numpy as np

from persist_cli.api.actions import STAY
from persist_cli.api.observations import Frame
from persist_cli.api.simulator import Simulator
from persist_cli.errors import DataError
from persist_cli.simulators.free_grid import FreeGrid, Ground, clear_distance
from persist_cli.simulators.way_back import Pose, WayBack

MOST_REFUSALS = 200  # in a row

# of explore
SIGHT = 4.0  # metres that it looks ahead
OPEN_VIEW = 0.75  # metres ahead that it likes to see: a wall before the nose shows nothing
EFFORT = 3.0  # metres of new ground that it gives for not turning right round
PATCH = 0.5  # metres of the squares in which it counts its visits

# of path
NEAR_GOAL = 0.4  # metres at which a goal counts as reached
LOOK_AROUND = 0.3  # how often it looks around before it sets out
PATIENCE = 4  # steps without getting nearer, after which it gives up a goal

# of loop
OUTWARD = 0.35  # of the actions that it goes away at least, before it asks how long the way back is
SPARE = 6  # actions that it may have left when it is back

# of interact
BEFORE_THING = (0.7, 1.3)  # metres from a thing's middle at which it is acted on
SIDES = 0.6  # metres of way beyond the nearest such place at which others are taken, too
HANDY = 1.5  # metres of way to a thing that make it 1 / e as likely as one beside the agent
TOGGLES = 0.4  # how often it toggles a thing before it picks it up
CARRY = (0.5, 2.5)  # metres along the ground to the place where it puts a thing down

ActionStream = Generator[str, bool, None]  # yields the next action, and is sent whether the world allowed it
Policy = Callable[[Simulator, np.random.Generator, int], ActionStream]


def walk(simulator: Simulator, policy: Policy, random: np.random.Generator, frames: int) -> Iterator[Frame]:
    """Let a policy walk from where the agent stands, and yield exactly ``frames`` observations.

    Each frame holds the action taken at it, the last none, and the scene's cells where the simulator knows them;
    timestamps count one second an action.

    Raises:
        DataError: when the world refuses every action of the policy.
        PluginError: when the simulator gives a wrong answer.
    """
    actions = policy(simulator, random, frames - 1)
    for number in range(frames - 1):
        frame = replace(simulator.observe(), cells=simulator.cells(), timestamp=float(number))
        yield replace(frame, action=_next_allowed(simulator, actions, first=number == 0))
    yield replace(simulator.observe(), cells=simulator.cells(), action=None, timestamp=float(frames - 1))


def explore(simulator: Simulator, random: np.random.Generator, count: int) -> ActionStream:
    """A random walk in straight runs, towards open and rarely visited ground; it turns away from obstacles."""
    visits: Counter[tuple[int, int]] = Counter()
    _, turn = _gait(simulator)
    while True:
        turns = _inviting_turn(simulator, random, visits)
        yield from _turned(turns)
        steps = yield from _step_ahead(simulator, int(random.integers(3, 13)), visits)
        if turns == 0 and steps == 0:  # the way looked free, but is blocked
            yield from _turned(int(random.choice([-1, 1])) * max(1, round(90 / turn)))


def path(simulator: Simulator, random: np.random.Generator, count: int) -> ActionStream:
    """Shortest paths between random places, one after another, sometimes with a look around before setting out."""
    yield from _paths(simulator, random, lambda turns: round(360 / _gait(simulator)[1]))


def _paths(simulator: Simulator, random: np.random.Generator, look_around: Callable[[int], int]) -> ActionStream:
    """Shortest paths; ``look_around`` gives the turns of a look around, of those towards the way."""
    grid = FreeGrid(simulator)
    reachable = sorted(grid.distances(simulator.agent[0]))
    _, turn = _gait(simulator)
    while True:
        looks = random.random() < LOOK_AROUND
        goal = grid.place(reachable[int(random.integers(len(reachable)))]) if reachable else simulator.agent[0]
        if looks:
            yield from _turned(look_around(_nearer_turn(simulator, grid, grid.distances(goal)) or 0))
        steps = yield from go_to(simulator, grid, goal)
        if steps == 0:
            yield from _turned(int(random.choice([-1, 1])) * int(random.integers(1, max(2, round(90 / turn)))))


def there_and_back(simulator: Simulator, random: np.random.Generator, count: int) -> ActionStream:
    """Out along a path or a random walk for half of ``count`` actions, then the reversed actions back."""
    out = path if random.random() < 0.5 else explore
    outward = out(simulator, random, count // 2)
    vocabulary = simulator.info.vocabulary
    taken: list[str] = []
    action = next(outward) if count >= 2 else STAY
    while len(taken) < count // 2:
        allowed = yield action
        if allowed:
            taken.append(action)
        action = outward.send(allowed)
    for action in [STAY] * (count % 2) + list(vocabulary.reversed(taken)):
        yield action


def loop(simulator: Simulator, random: np.random.Generator, count: int) -> ActionStream:
    """Out along paths or a random walk, and back to the start by another way.

    On the way back hardly any pose is near one of the way out (``near_poses`` of ``api.geometry``), yet most of what it
    looks at was seen on the way out.
    """
    back = WayBack(simulator)
    out = paths_without_copies if random.random() < 0.5 else explore
    way = yield from _go_out(simulator, out(simulator, random, count), count, back)
    while True:
        for action in way:
            allowed = yield action
            if not allowed:
                back.block(action)
                break
            back.visited.add(Pose(*simulator.agent))
        else:
            way = [back.linger()]
            continue
        way = back.plan()


def paths_without_copies(simulator: Simulator, random: np.random.Generator, count: int) -> ActionStream:
    """As ``path``, but a look around is a turn the long way round to where it goes, which shows nothing twice."""
    whole = round(360 / _gait(simulator)[1])
    yield from _paths(simulator, random, lambda turns: turns - int(math.copysign(whole, turns)) if turns else 0)


def interact(simulator: Simulator, random: np.random.Generator, count: int) -> ActionStream:
    """Walks to things that can be moved, toggles some of them, picks them up, and puts them down elsewhere.

    Where nothing can be moved it walks as ``path`` does.
    """
    grid = FreeGrid(simulator)
    while True:
        chosen = _place_before_a_thing(simulator, grid, random)
        if chosen is None:
            yield from path(simulator, random, count)
            return
        place, thing = chosen
        yield from go_to(simulator, grid, place)
        yield from _turned(_turns_towards(simulator, thing))
        if random.random() < TOGGLES:
            yield "toggle"
        if not (yield "pick_up"):
            yield from _turned(int(random.choice([-1, 1])))
            continue
        yield from _carry(simulator, grid, random)
        yield "drop"
        grid = FreeGrid(simulator)


def _carry(simulator: Simulator, grid: FreeGrid, random: np.random.Generator) -> ActionStream:
    """Walk with a thing to a place not far from here, or as near to it as the thing gets."""
    away = grid.distances(simulator.agent[0])
    places = [cell for cell, distance in sorted(away.items()) if CARRY[0] <= distance <= CARRY[1]]
    if places:
        yield from go_to(simulator, grid, grid.place(places[int(random.integers(len(places)))]))
    yield from _turned(int(random.integers(-2, 3)))


def _place_before_a_thing(
    simulator: Simulator, grid: FreeGrid, random: np.random.Generator
) -> tuple[Ground, Ground] | None:
    """A reachable place near a thing that can be moved, and the thing's; near things are likelier."""
    away = grid.distances(simulator.agent[0])
    low, high = BEFORE_THING
    sides = {thing: [cell for cell in sorted(away) if low <= math.dist(grid.place(cell), thing) <= high]
             for thing in simulator.movable()}  # fmt: skip
    things = [thing for thing, cells in sides.items() if cells]
    if not things:
        return None
    ways = np.array([min(away[cell] for cell in sides[thing]) for thing in things])
    likely = np.exp((ways.min() - ways) / HANDY)
    number = int(random.choice(len(things), p=likely / likely.sum()))
    thing = things[number]
    near = [cell for cell in sides[thing] if away[cell] <= ways[number] + SIDES]
    return grid.place(near[int(random.integers(len(near)))]), thing


def _turns_towards(simulator: Simulator, place: Ground) -> int:
    """Number of turns to the left (negative: right) after which the agent looks towards a place."""
    _, turn = _gait(simulator)
    (x, z), heading = simulator.agent
    most = int(180 // turn)
    headings = [(turns, simulator.ahead(heading + math.radians(turns * turn))) for turns in range(-most, most + 1)]
    return max(headings, key=lambda one: one[1][0] * (place[0] - x) + one[1][1] * (place[1] - z))[0]


POLICIES: dict[str, Policy] = {
    "explore": explore, "path": path, "there-and-back": there_and_back, "loop": loop, "interact": interact,
}  # fmt: skip


def _go_out(simulator: Simulator, outward: ActionStream, count: int, back: WayBack) -> Generator[str, bool, list[str]]:
    """Go out until no more actions are left than the way back takes, and return the way back."""
    action, taken, leave = next(outward), 0, OUTWARD * count
    while True:
        allowed = yield action
        if allowed:
            taken += 1
            back.visited.add(Pose(*simulator.agent))
        if allowed and taken >= leave:
            way = back.plan()
            spare = count - taken - len(way)
            if spare <= SPARE:
                return way
            leave = taken + max(2, spare // 3)
        action = outward.send(allowed)


def _next_allowed(simulator: Simulator, actions: ActionStream, first: bool) -> str:
    """Do the policy's next action that the world allows, and return its name."""
    action = next(actions) if first else actions.send(True)
    for _ in range(MOST_REFUSALS):
        if simulator.act(action):
            return action
        action = actions.send(False)
    raise DataError(f"{simulator.info.scene}: the agent cannot move; the last {MOST_REFUSALS} actions were refused")


def _step_ahead(simulator: Simulator, most: int, visits: Counter[tuple[int, int]]) -> Generator[str, bool, int]:
    """Step straight ahead until something is in the way, and return the number of steps."""
    step, _ = _gait(simulator)
    for steps in range(most):
        ground, heading = simulator.agent
        visits[_patch(ground)] += 1
        view = step if steps == 0 else step * math.ceil(OPEN_VIEW / step)
        if clear_distance(simulator, ground, heading, view, step) < view or not (yield "forward"):
            return steps
    return most


def _inviting_turn(simulator: Simulator, random: np.random.Generator, visits: Counter[tuple[int, int]]) -> int:
    """Number of turns to the left (negative: right) towards long and rarely visited ways, by chance."""
    step, turn = _gait(simulator)
    ground, heading = simulator.agent
    most = int(180 // turn)
    options = range(-most, most + 1)
    scores = []
    for turns in options:
        way = heading + math.radians(turns * turn)
        length = clear_distance(simulator, ground, way, SIGHT, step)
        x, z = simulator.ahead(way)
        seen = [visits[_patch((ground[0] + d * x, ground[1] + d * z))] for d in np.arange(step, length + 1e-9, PATCH)]
        novelty = sum(1 / (1 + count) ** 2 for count in seen) * PATCH
        effort = EFFORT * abs(turns) / max(most, 1)
        dull = 9.0 * (length < step) + 1.0 * (length < OPEN_VIEW)
        scores.append(novelty + 0.25 * min(length, 2.0) - effort - dull + float(random.gumbel(0, 0.25)))
    return options[int(np.argmax(scores))]


def go_to(simulator: Simulator, grid: FreeGrid, goal: Ground) -> Generator[str, bool, int]:
    """Turn and step along the shortest way to the goal until near it or no nearer, and return the number of steps."""
    distances = grid.distances(goal)
    step, _ = _gait(simulator)
    best, patience, steps = math.inf, 0, 0
    while patience < PATIENCE:
        ground, _ = simulator.agent
        distance = grid.remaining(ground, distances)
        best, patience = (distance, 0) if distance < best - 1e-9 else (best, patience + 1)
        turns = _nearer_turn(simulator, grid, distances)
        if distance < max(NEAR_GOAL, step) or turns is None:
            break
        yield from _turned(turns)
        if not (yield "forward"):
            break
        steps += 1
    return steps


def _nearer_turn(simulator: Simulator, grid: FreeGrid, distances: dict[tuple[int, int], float]) -> int | None:
    """Number of turns towards the way whose first steps lead nearest to the goal; ``None`` where all are blocked."""
    step, turn = _gait(simulator)
    ground, heading = simulator.agent
    most = int(180 // turn)
    best: tuple[float, int] | None = None
    for turns in sorted(range(-most, most + 1), key=abs):
        way = heading + math.radians(turns * turn)
        if clear_distance(simulator, ground, way, step, step) < step:
            continue
        x, z = simulator.ahead(way)
        for walked in (step, 2 * step, 3 * step):
            place = ground[0] + walked * x, ground[1] + walked * z
            cost = grid.remaining(place, distances) + walked + 0.02 * abs(turns)
            if math.isinf(cost):
                break
            if best is None or cost < best[0] - 1e-9:
                best = cost, turns
    return None if best is None else best[1]


def _turned(turns: int) -> ActionStream:
    """Turn to the left, or to the right where negative."""
    for _ in range(abs(turns)):
        yield "left" if turns > 0 else "right"


def _gait(simulator: Simulator) -> tuple[float, float]:
    """Metres of a step forward and degrees of a turn to the left."""
    vocabulary = simulator.info.vocabulary
    return vocabulary["forward"].forward, vocabulary["left"].turn


def _patch(ground: Ground) -> tuple[int, int]:
    return math.floor(ground[0] / PATCH), math.floor(ground[1] / PATCH)
