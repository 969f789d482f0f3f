"""The methods of planning: rank the proposals of a policy, or search over actions by the cross-entropy method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import torch
from jaxtyping import Float
from pydantic import PositiveInt
from torch import Tensor

from persist_cli.api.actions import ActionVocabulary
from persist_cli.api.policy import Policy, Situation
from persist_cli.errors import PersistError
from persist_cli.planning.judge import Candidate, Judge

OnRound = Callable[[int, float], None]  # is told the number of a round and the least cost so far


@dataclass(frozen=True)
class Plan:
    """What a planner found.

    Args:
        candidates: all that were judged, the first to be judged first.
        rounds: number of rounds begun.
        judged: actions of all candidates together, which a budget of frames counts.
        frames: imagined frames; none where the cost looks at poses alone.
        seconds: of judging.
        exhausted: whether the budget ended it.
    """

    candidates: list[Candidate]
    rounds: int
    judged: int
    frames: int
    seconds: float
    exhausted: bool

    @property
    def best(self) -> Candidate:
        """The candidate of least cost; of equal ones the first."""
        return min(self.candidates, key=lambda candidate: candidate.cost)

    @property
    def actions(self) -> tuple[str, ...]:
        """The chosen actions, without blocked ones; empty means: stay here."""
        return self.best.chosen


def nothing(number: int, cost: float) -> None:
    """Take no notice of a round."""


class Planner(Protocol):
    """A method of planning."""

    def plan(self, situation: Situation, judge: Judge, generator: torch.Generator, on_round: OnRound = nothing) -> Plan:
        """Return a plan from a situation.

        Args:
            situation: what the agent knows; its goal is the judge's.
            judge: judges candidates within its budget.
            generator: source of all that is random.
            on_round: is called after each round.
        """
        ...

    def executed(self, count: int) -> None:
        """Let the planner know that so many of the chosen actions were done, before it plans again."""
        ...


@dataclass(frozen=True)
class RankSettings:
    """How many proposals are ranked.

    Args:
        horizon: most actions of a proposal.
        candidates: proposals of a round.
        rounds: rounds, each of new proposals.
        keep: whether what is left of the last plan is one of the next plan's candidates, in place of a proposal. Else
            an agent that plans again forgets a good way whenever the new proposals are worse.
    """

    horizon: PositiveInt = 8
    candidates: PositiveInt = 16
    rounds: PositiveInt = 1
    keep: bool = False


class Rank:
    """Imagines the proposals of a policy and takes the one of least cost (PEWM, section 4.3).

    Args:
        policy: proposes.
        settings: how many.

    Raises:
        PersistError: when the policy does not look as far ahead as the horizon.
    """

    def __init__(self, policy: Policy, settings: RankSettings) -> None:
        check_horizon(policy, settings.horizon)
        self.policy, self.settings = policy, settings
        self._last: tuple[str, ...] = ()  # what is left of the last plan

    def plan(self, situation: Situation, judge: Judge, generator: torch.Generator, on_round: OnRound = nothing) -> Plan:
        """Return the judged proposals; see ``Planner``."""
        horizon, count, number = self.settings.horizon, self.settings.candidates, 0
        while number < self.settings.rounds and not judge.exhausted:
            number += 1
            kept = [self._last] if self._last and number == 1 else []
            proposals = self.policy.proposals(situation, horizon, max(count - len(kept), 1), generator)
            judge.judge([*kept, *proposals][:count], number)
            on_round(number, least(judge))
        plan = finished(judge, number)
        self._last = plan.actions if self.settings.keep else ()
        return plan

    def executed(self, count: int) -> None:
        """Drop the actions that were done from the plan that is kept."""
        self._last = self._last[count:]


def check_horizon(policy: Policy | None, horizon: int) -> None:
    """Raise ``PersistError`` when a policy does not look as far ahead as a horizon."""
    if policy is not None and policy.longest is not None and horizon > policy.longest:
        raise PersistError(
            f"policy {policy.name!r} looks at most {policy.longest} actions ahead, not {horizon}; give "
            f"--horizon {policy.longest}"
        )


@dataclass(frozen=True)
class CemSettings:
    """The cross-entropy method over discrete actions (PEWM, section 4.3), with options of iCEM (Pinneri et al. 2020).

    Args:
        horizon: actions of a candidate.
        candidates: candidates of a round.
        rounds: most rounds.
        elites: share of the candidates, the best, that the distributions follow.
        smoothing: share of the old distributions in the new ones.
        kept: share of the elites that the next round judges again beside its own, as in iCEM; 0 for none.
        shift: share of the last plan's distributions, shifted by what was executed, in those that the next plan begins
            with, and whether its best candidate is among the first; 0 begins uniform each time.
        proposed: share of the first round's candidates that the policy proposes, where there is one.
        actions: names of the actions to choose from; by default those that walk ahead or turn.
    """

    horizon: PositiveInt = 8
    candidates: PositiveInt = 60
    rounds: PositiveInt = 12
    elites: float = 0.3
    smoothing: float = 0.2
    kept: float = 0.0
    shift: float = 0.0
    proposed: float = 0.5
    actions: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name, value, low in (
            ("elites", self.elites, 1e-9), ("smoothing", self.smoothing, 0.0), ("kept", self.kept, 0.0),
            ("shift", self.shift, 0.0), ("proposed", self.proposed, 0.0),
        ):  # fmt: skip
            if not low <= value <= 1:
                place = "above 0 and at most at 1" if low else "between 0 and 1"
                raise ValueError(f"{name} {value:g} is a share; it must lie {place}")


class Remainder(NamedTuple):
    """What is left of a plan of ``Cem``, from which the next plan may begin.

    Args:
        probabilities: of each action, where the plan ended.
        actions: of the best candidate.
        chosen: numbers, from 0, of those of its actions that were chosen.
    """

    probabilities: Float[Tensor, "action name"]
    actions: tuple[str, ...]
    chosen: list[int]

    def after(self, count: int) -> Remainder | None:
        """Return what is left after ``count`` of the chosen actions were done; ``None`` when nothing is."""
        chosen = self.chosen[count:]
        if not chosen:
            return None
        done = chosen[0]  # blocked actions before the next one are over, too
        uniform = torch.full_like(self.probabilities, 1 / self.probabilities.shape[1])
        probabilities = torch.cat([self.probabilities, uniform])[done : done + len(uniform)]
        actions = (*self.actions, *self.actions[-1:] * done)[done:]
        return Remainder(probabilities, actions, [number - done for number in chosen])


@dataclass
class Cem:
    """Searches over sequences of actions: draws, judges, and follows the best in the next round.

    A plan is not the last round's mean but the best candidate of all.

    Args:
        settings: of the method.
        policy: proposes a part of the first round; ``None`` to draw all of it. Random actions hardly ever lead to a
            hidden goal, so that without proposals there is nothing to follow.

    Raises:
        PersistError: when the policy does not look as far ahead as the horizon.
    """

    settings: CemSettings
    policy: Policy | None = None
    _last: Remainder | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        check_horizon(self.policy, self.settings.horizon)

    def plan(self, situation: Situation, judge: Judge, generator: torch.Generator, on_round: OnRound = nothing) -> Plan:
        """Return all judged candidates; see ``Planner``.

        Raises:
            DataError: for an action that the vocabulary lacks.
        """
        settings, names = self.settings, action_names(situation.info.vocabulary, self.settings.actions)
        probabilities, kept, number = *self._begin(names), 0
        kept = [*kept, *self._proposals(situation, names, generator)][: settings.candidates]
        while number < settings.rounds and not judge.exhausted:
            number += 1
            drawn = draw(probabilities, names, settings.candidates - len(kept), generator)
            candidates = judge.judge([*kept, *drawn], number)
            on_round(number, least(judge))
            if judge.exhausted:
                break
            # every draw counts, the repeated too, as the distributions say how often they come
            costs = {candidate.actions: candidate.cost for candidate in candidates}
            ranked = sorted([*kept, *drawn], key=lambda one: costs[one])
            elites = ranked[: max(1, round(settings.elites * len(ranked)))]
            share = settings.smoothing
            probabilities = share * probabilities + (1 - share) * frequencies(elites, names, probabilities)
            kept = list(dict.fromkeys(elites))[: round(settings.kept * len(elites))]
        plan = finished(judge, number)
        self._last = Remainder(probabilities, plan.best.actions, plan.best.chosen_numbers)
        return plan

    def executed(self, count: int) -> None:
        """Shift the distributions that the next plan begins with by the actions that were done."""
        self._last = None if self._last is None else self._last.after(count)

    def _proposals(
        self, situation: Situation, names: Sequence[str], generator: torch.Generator
    ) -> list[tuple[str, ...]]:
        """Return the policy's share of the first round: its proposals of these actions."""
        count = round(self.settings.proposed * self.settings.candidates)
        if self.policy is None or not count:
            return []
        proposals = self.policy.proposals(situation, self.settings.horizon, count, generator)
        return [proposal for proposal in proposals if set(proposal) <= set(names)]

    def _begin(self, names: Sequence[str]) -> tuple[Float[Tensor, "action name"], list[tuple[str, ...]]]:
        """Return the distributions of the first round, and candidates to judge beside those that are drawn."""
        uniform = torch.full((self.settings.horizon, len(names)), 1 / len(names), dtype=torch.float64)
        if not self.settings.shift or self._last is None or self._last.probabilities.shape != uniform.shape:
            return uniform, []
        share = self.settings.shift
        return share * self._last.probabilities + (1 - share) * uniform, [self._last.actions]


def action_names(vocabulary: ActionVocabulary, chosen: Sequence[str]) -> list[str]:
    """Return the chosen actions, or those that walk ahead or turn.

    Raises:
        DataError: for an action that the vocabulary lacks.
        PersistError: when none is chosen and none walks or turns.
    """
    names = [vocabulary[name].name for name in dict.fromkeys(chosen)] or [action.name for action in vocabulary.moving]
    if not names:
        raise PersistError(f"no action walks ahead or turns, so that nothing can be planned: {vocabulary.listing()}")
    return names


def draw(
    probabilities: Float[Tensor, "action name"], names: Sequence[str], count: int, generator: torch.Generator
) -> list[tuple[str, ...]]:
    """Return ``count`` sequences, each action drawn from its own distribution."""
    if count < 1:
        return []
    numbers = torch.multinomial(probabilities, count, replacement=True, generator=generator).T
    return [tuple(names[number] for number in row) for row in numbers.tolist()]


def frequencies(
    sequences: Sequence[Sequence[str]], names: Sequence[str], otherwise: Float[Tensor, "action name"]
) -> Float[Tensor, "action name"]:
    """Return how often each action has each name, as shares.

    Args:
        sequences: some may be shorter than others.
        names: of the actions.
        otherwise: shares of the actions that no sequence is long enough for.
    """
    counts = torch.zeros_like(otherwise)
    for sequence in sequences:
        for place, name in enumerate(sequence):
            counts[place, names.index(name)] += 1
    total = counts.sum(1, keepdim=True)
    return torch.where(total > 0, counts / total.clamp_min(1), otherwise)


def least(judge: Judge) -> float:
    """Return the least cost so far."""
    return min(candidate.cost for candidate in judge.judged.values())


def finished(judge: Judge, rounds: int) -> Plan:
    """Return the plan of all that was judged; a round for which no budget was left does not count."""
    candidates = list(judge.judged.values())
    begun = max(candidate.round for candidate in candidates) if judge.exhausted else rounds
    return Plan(candidates, begun, judge.actions, judge.frames, judge.seconds, judge.exhausted)
