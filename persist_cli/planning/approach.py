"""The last steps to a goal that was recognised: straight ways ahead and to both sides, which a planner compares.

For example a goal image is recognised from two metres behind the place where it was taken. Its view looks much the same
from there, so no threshold of a cost tells near from far. But it costs less with every step towards that place, and
more beyond it: the agent imagines some steps in several directions, and goes to the best view of all.
"""

from __future__ import annotations

from persist_cli.api.actions import ActionVocabulary
from persist_cli.planning.judge import Judge
from persist_cli.policies.simple import gait

SIDES = 3  # turns to each side at most


def straight_ways(vocabulary: ActionVocabulary, horizon: int) -> list[tuple[str, ...]]:
    """Return ways of ``horizon`` actions: some turns to a side, none to ``SIDES``, and steps straight ahead.

    Raises:
        PersistError: when the vocabulary has no step ahead or no turn.
    """
    ahead, turns = gait(vocabulary)
    starts = [(), *((turn.name,) * count for count in range(1, SIDES + 1) for turn in turns)]
    ways = [(*start, *(ahead.name,) * (horizon - len(start)))[:horizon] for start in starts]
    return list(dict.fromkeys(ways))


def glances(vocabulary: ActionVocabulary) -> list[tuple[str, ...]]:
    """Return a turn to each side and back; where there are turns to one side only, no action at all."""
    _, turns = gait(vocabulary)
    names = [turn.name for turn in turns]
    return list(zip(names, reversed(names), strict=True)) if len(names) > 1 else [()]


def approach_ways(vocabulary: ActionVocabulary, horizon: int) -> list[tuple[str, ...]]:
    """Return all ways that ``best_approach`` compares: those that stay, then those that go; errors as of these."""
    return [*glances(vocabulary), *straight_ways(vocabulary, horizon)]


def best_approach(judge: Judge, vocabulary: ActionVocabulary, horizon: int) -> tuple[str, ...]:
    """Return the actions to the best view on straight ways; none where the view is as good without a step.

    What is imagined costs more than what is truly seen, so the view without a step is imagined too, by ``glances``.

    Args:
        judge: judges every frame of a candidate (``over`` is ``best``).
        vocabulary: of the agent.
        horizon: actions of each way.
    """
    judged, here = judge.judge(approach_ways(vocabulary, horizon), 1), len(glances(vocabulary))
    stay, best = (min(part, key=lambda one: one.cost) for part in (judged[:here], judged[here:]))
    return best.chosen if best.cost < stay.cost else ()
