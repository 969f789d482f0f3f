"""Waypoints, or the place of a goal, followed by the actions of a vocabulary: turn towards it, and walk."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from persist_cli.api.actions import Action

LOOK_AHEAD: Final = 2  # steps


def follow_waypoints(
    waypoints: Sequence[tuple[float, float]], ahead: Action, turns: Sequence[Action], horizon: int
) -> tuple[str, ...]:
    """Return at least one and at most ``horizon`` actions that lead along waypoints.

    The agent looks at the first waypoint that is at least two steps away, turns until it is within half a turn of its
    heading, and walks. Nearer ones would let it turn to and fro. It ends within half a step of the last one.

    Args:
        waypoints: metres ahead and to the left of where the agent is now.
        ahead: a step straight ahead.
        turns: a turn to each side, or to one side alone.
        horizon: largest number of actions, at least 1.
    """
    x = y = heading = 0.0
    target, names = 0, list[str]()
    while len(names) < horizon:
        distances = [math.dist((x, y), waypoint) for waypoint in waypoints]
        while target < len(waypoints) - 1 and distances[target] < LOOK_AHEAD * ahead.forward:
            target += 1
        if target == len(waypoints) - 1 and distances[target] <= ahead.forward / 2 and names:
            break
        angle = math.degrees(math.atan2(waypoints[target][1] - y, waypoints[target][0] - x)) - heading
        turn = _turn_towards(angle, turns)
        if turn is None:
            x += ahead.forward * math.cos(math.radians(heading))
            y += ahead.forward * math.sin(math.radians(heading))
        else:
            heading += turn.turn
        names.append((turn or ahead).name)
    return tuple(names)


def go_straight_and_face(
    place: tuple[float, float], heading: float, ahead: Action, turns: Sequence[Action]
) -> tuple[str, ...]:
    """Return the actions that turn to a place, go straight there, and turn to a heading; none where both are so.

    Args:
        place: metres ahead and to the left of where the agent is now.
        heading: degrees to the left of its heading.
        ahead: a step straight ahead.
        turns: a turn to each side, or to one side alone.
    """
    steps = round(math.hypot(*place) / ahead.forward)
    way = math.degrees(math.atan2(place[1], place[0]))
    names, turned = _turns(way, turns) if steps else ((), 0.0)
    return (*names, *[ahead.name] * steps, *_turns(heading - turned, turns)[0])


def _turns(angle: float, turns: Sequence[Action]) -> tuple[tuple[str, ...], float]:
    """The names of the turns that come nearest to an angle in degrees, and the degrees that they turn."""
    names, turned = list[str](), 0.0
    while turn := _turn_towards(angle - turned, turns):
        names.append(turn.name)
        turned += turn.turn
    return tuple(names), turned


def _turn_towards(angle: float, turns: Sequence[Action]) -> Action | None:
    """The turn by which an angle in degrees takes the fewest turns; ``None`` where it is within half of one."""
    nearest = min(turns, key=lambda turn: (angle if turn.turn > 0 else -angle) % 360 / abs(turn.turn))
    left = (angle + 180) % 360 - 180
    return None if abs(left) <= abs(nearest.turn) / 2 + 1e-6 else nearest
