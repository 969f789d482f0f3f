"""Which actions the held keys mean."""

from __future__ import annotations

import math
from collections.abc import Collection

from persist_cli.api.actions import FREE, Action, ActionVocabulary


def walking_keys(vocabulary: ActionVocabulary) -> tuple[Action, ...]:
    """Return the actions that a key can have: all but ``free``, which has no motion of its own."""
    return tuple(action for action in vocabulary.actions if action.name != FREE)


def held_actions(held: Collection[str], vocabulary: ActionVocabulary) -> tuple[str, ...]:
    """Return the actions that are taken in turn while some are held, without interactions.

    For example ``forward`` and ``left`` are held. A vocabulary with an action that does both takes that one; else a
    step and a turn follow each other. Opposite actions cancel out.

    Args:
        held: names of actions.
        vocabulary: the actions.

    Raises:
        DataError: for an action that the vocabulary lacks.
    """
    actions = [action for action in map(vocabulary.__getitem__, sorted(held)) if not action.interaction]
    left = [one for one in actions if not any(one.reverse == other.name != one.name for other in actions)]
    moves = [action for action in left if action.forward or action.turn]
    if len(moves) > 1:
        both = _doing_all(moves, vocabulary)
        return (both.name,) if both is not None else tuple(action.name for action in _steps_first(moves))
    return tuple(action.name for action in moves or left[:1])


def _doing_all(moves: Collection[Action], vocabulary: ActionVocabulary) -> Action | None:
    """Return the action that steps and turns to the sides of all these moves at once, if there is one."""
    sides = _sides(sum(move.forward for move in moves), sum(move.turn for move in moves))
    return next((one for one in vocabulary.actions if _sides(one.forward, one.turn) == sides and all(sides)), None)


def _sides(forward: float, turn: float) -> tuple[float, float]:
    """Return the signs of a step and a turn, 0 for none."""
    return (math.copysign(1, forward) if forward else 0, math.copysign(1, turn) if turn else 0)


def _steps_first(moves: Collection[Action]) -> list[Action]:
    return sorted(moves, key=lambda action: (not action.forward, action.name))
