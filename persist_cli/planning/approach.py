"""The last steps to a goal that was recognised: short ways, which a planner compares.

For example a goal image is recognised from two metres behind the place where it was taken. Its view looks much the same
from there, so no threshold of a cost tells near from far. But it costs less with every step towards that place, and
more beyond it: the agent imagines some steps in several directions, and goes to the best view of all.

From half a metre beside the line through that place a straight way does not lead to it, or leads to it with the view
turned away. Where no straight way is better, the agent compares ways aside, which turn back at their end.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from persist_cli.api.actions import Action, ActionVocabulary
from persist_cli.planning.judge import Judge
from persist_cli.policies.simple import gait

SIDES = 3  # turns to each side at most

ASIDE = (30.0, 60.0)  # degrees to a side of the ways aside

METRES = (0.5, 1.0)  # of the ways aside

BACK = 30.0  # degrees beyond the first heading to which they turn back

Way = tuple[str, ...]


def straight_ways(vocabulary: ActionVocabulary, horizon: int) -> list[Way]:
    """Return ways of ``horizon`` actions: some turns to a side, none to ``SIDES``, and steps straight ahead.

    Raises:
        PersistError: when the vocabulary has no step ahead or no turn.
    """
    ahead, turns = gait(vocabulary)
    starts = [(), *((turn.name,) * count for count in range(1, SIDES + 1) for turn in turns)]
    ways = [(*start, *(ahead.name,) * (horizon - len(start)))[:horizon] for start in starts]
    return list(dict.fromkeys(ways))


def glances(vocabulary: ActionVocabulary) -> list[Way]:
    """Return a turn to each side and back; where there are turns to one side only, no action at all."""
    _, turns = gait(vocabulary)
    names = [turn.name for turn in turns]
    return list(zip(names, reversed(names), strict=True)) if len(names) > 1 else [()]


def ways_aside(vocabulary: ActionVocabulary) -> list[Way]:
    """Return ways that turn to a side, go ahead, and turn back beyond the first heading; none without two turns.

    Raises:
        PersistError: when the vocabulary has no step ahead or no turn.
    """
    ahead, turns = gait(vocabulary)
    if len(turns) == 1:
        return []
    return [
        (*_turned(away, angle), *(ahead.name,) * max(1, round(metres / ahead.forward)), *_turned(back, angle + BACK))
        for away, back in (turns, turns[::-1])
        for angle, metres in itertools.product(ASIDE, METRES)
    ]


def _turned(turn: Action, degrees: float) -> Way:
    """Turn by about so many degrees, once at least."""
    return (turn.name,) * max(1, round(degrees / abs(turn.turn)))


def best_view(judge: Judge, stay: Sequence[Way], ways: Sequence[Way]) -> Way:
    """Return the actions to the best view on some ways; none where one without a step costs as little.

    What is imagined costs more than what is truly seen, so views without a step are imagined too.

    Args:
        judge: judges every frame of a candidate (``over`` is ``best``).
        stay: ways without a step.
        ways: that are compared with them.
    """
    judged = {one.actions: one for one in judge.judge([*stay, *ways], 1)}
    here, there = (min((judged[way] for way in part), key=lambda one: one.cost) for part in (stay, ways))
    return there.chosen if there.cost < here.cost else ()


def best_approach(judge: Judge, vocabulary: ActionVocabulary, horizon: int) -> Way:
    """Return the actions to the best view on straight ways; where none is better, on ways aside; else none.

    Args:
        judge: judges every frame of a candidate (``over`` is ``best``).
        vocabulary: of the agent.
        horizon: actions of each straight way.

    Raises:
        PersistError: when the vocabulary has no step ahead or no turn.
    """
    stay = glances(vocabulary)
    stages = filter(None, (straight_ways(vocabulary, horizon), ways_aside(vocabulary)))
    return next(filter(None, (best_view(judge, stay, ways) for ways in stages)), ())
