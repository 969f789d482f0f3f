"""Candidates of a plan, judged in batches within a budget."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from persist_cli.api.actions import format_actions
from persist_cli.api.cost import Cost
from persist_cli.api.geometry import near_poses
from persist_cli.api.ground import GroundMap
from persist_cli.api.policy import Goal, Policy
from persist_cli.errors import PersistError
from persist_cli.planning.futures import CandidateWalk, FutureModel, Over

NEAR: Final = 0.3  # metres between two poses of one view

TURNED: Final = 20.0  # degrees between them

LAST: Final = 1_000.0  # more than any cost of an image


@dataclass(frozen=True)
class Budget:
    """The most that a plan may take; ``None`` for no bound.

    Args:
        frames: imagined frames, one for each action of a candidate; counted too where the cost looks at poses alone.
        seconds: of judging.
    """

    frames: int | None = None
    seconds: float | None = None

    def __post_init__(self) -> None:
        if self.frames is not None and self.frames < 1:
            raise PersistError(f"a budget of {self.frames} frames imagines nothing; give --frames at least one horizon")
        if self.seconds is not None and not 0 < self.seconds < math.inf:
            raise PersistError(f"a budget of {self.seconds:g} seconds; give --seconds above 0, or none for no bound")


@dataclass(frozen=True)
class Candidate:
    """A sequence of actions that was judged.

    Args:
        actions: names of all its actions.
        cost: of the frame that counts.
        best: number of actions after which that frame is seen.
        walk: where it leads.
        round: number of the round that proposed it, from 1.
    """

    actions: tuple[str, ...]
    cost: float
    best: int
    walk: CandidateWalk
    round: int

    @property
    def chosen(self) -> tuple[str, ...]:
        """Its actions up to the frame that counts, without those that move nothing as their way is blocked.

        Where all are blocked they are all there, since what is known of the ground may be wrong.
        """
        return tuple(self.actions[number] for number in self.chosen_numbers)

    @property
    def chosen_numbers(self) -> list[int]:
        """Numbers, from 0, of the actions that are chosen."""
        numbers = list(range(self.best))
        return [number for number in numbers if self.walk.free[number]] or numbers


@dataclass
class Judge:
    """Imagines candidates in batches and measures what they cost; one that comes again is not imagined again.

    Args:
        model: imagines.
        cost: measures.
        goal: has what the cost reads.
        ground: what the agent knows to be free.
        over: ``last`` judges the last frame of each candidate, ``best`` the one that costs least.
        budget: the most that may be spent; at least one batch is judged.
        batch: candidates imagined together.
        on_batch: is told how many actions each batch had.
        looked: world_from_camera of the poses where the agent truly looked and did not find its goal, metres; a frame
            from one of them comes after all others. ``None`` for a goal of which no image tells whether it is found.
    """

    model: FutureModel
    cost: Cost
    goal: Goal
    ground: GroundMap
    over: Over = "last"
    budget: Budget = field(default_factory=Budget)
    batch: int = 20
    on_batch: Callable[[int], object] | None = None
    looked: Float[Tensor, "pose 4 4"] | None = None
    judged: dict[tuple[str, ...], Candidate] = field(default_factory=dict, init=False)
    actions: int = field(default=0, init=False)  # judged so far
    seconds: float = field(default=0.0, init=False)  # spent so far
    exhausted: bool = field(default=False, init=False)  # whether candidates were left out for lack of budget
    _rate: float = field(default=0.0, init=False)  # seconds an action in the last batch

    @property
    def frames(self) -> int:
        """Number of frames that were imagined so far: none for a cost that looks at poses alone."""
        return self.actions if self.cost.sees else 0

    def judge(self, candidates: Sequence[Sequence[str]], number: int) -> list[Candidate]:
        """Return the judged candidates of a round, in their order, without those that the budget does not allow.

        Args:
            candidates: names of actions.
            number: of the round.

        Raises:
            PersistError: when a cost is NaN, or the budget does not suffice for the very first candidate.
        """
        unique = list(dict.fromkeys(tuple(names) for names in candidates))
        fresh = [names for names in unique if names not in self.judged]
        while fresh and not self.exhausted:
            allowed = self._allowed(fresh[: self.batch])
            self.exhausted = len(allowed) < len(fresh[: self.batch])
            if allowed:
                self._judge_batch(allowed, number)
            fresh = fresh[len(allowed) :]
        return [self.judged[names] for names in unique if names in self.judged]

    def _allowed(self, candidates: list[tuple[str, ...]]) -> list[tuple[str, ...]]:
        """Return as many of a batch's candidates as the budget allows."""
        left = math.inf if self.budget.frames is None else self.budget.frames - self.actions
        if self.budget.seconds is not None and self._rate:
            left = min(left, (self.budget.seconds - self.seconds) / self._rate)
        allowed, spent = [], 0
        for names in candidates:
            spent += len(names)
            if spent <= left:
                allowed.append(names)
        if not allowed and not self.judged:
            raise PersistError(
                f"a budget of {self.budget.frames} frames does not suffice for one candidate of {len(candidates[0])} "
                "actions; raise --frames or lower --horizon"
            )
        return allowed

    def _judge_batch(self, candidates: list[tuple[str, ...]], number: int) -> None:
        begun = time.monotonic()
        imagined = self.model.imagine(candidates, self.over, self.cost.sees)
        costs = self.cost.measured(imagined.futures, self.goal, self.ground).double().cpu()
        self.check(costs, candidates)
        if self.looked is not None:
            poses = imagined.futures.world_from_camera.double().cpu()
            costs += LAST * near_poses(poses.flatten(0, 1), self.looked, NEAR, TURNED).any(-1).reshape(costs.shape)
        least, frame = costs.min(dim=1)
        for row, names in enumerate(candidates):
            best = len(names) if self.over == "last" else min(int(frame[row]) + 1, len(names))
            self.judged[names] = Candidate(names, float(least[row]), best, imagined.walks[row], number)
        actions, seconds = sum(map(len, candidates)), time.monotonic() - begun
        self.actions, self.seconds = self.actions + actions, self.seconds + seconds
        self._rate = seconds / max(actions, 1)
        if self.on_batch is not None:
            self.on_batch(actions)

    def check(self, costs: Float[Tensor, "candidate frame"], candidates: Sequence[Sequence[str]]) -> None:
        """Raise ``PersistError`` when a cost is NaN, naming the first such candidate."""
        wrong = torch.isnan(costs).any(dim=1).nonzero()
        if len(wrong):
            actions = format_actions(candidates[int(wrong[0])]) or "no action"
            raise PersistError(
                f"cost {self.cost.name!r} of {actions!r} is NaN ({len(wrong)} of {len(candidates)} candidates); take "
                "another --cost, or see what the model imagines with `persist rollout`"
            )


def check_goal(goal: Goal, cost: Cost, policy: Policy | None = None) -> None:
    """Raise ``PersistError`` when the cost or the policy cannot use the goal, or the cost lacks its weights."""
    if cost.reads not in goal.kinds:
        give = (
            "an image or a frame DATA#trajectory:frame" if cost.reads == "image" else "a place x,y or a frame of data"
        )
        other = "distance, geodesic" if cost.reads == "image" else "lpips, dreamsim, dino"
        raise PersistError(
            f"cost {cost.name!r} needs the {cost.reads} of the goal, which has none; give {give}, or another cost "
            f"({other})"
        )
    if policy is not None and policy.reads and not policy.reads & goal.kinds:
        kinds = " or ".join(sorted(policy.reads))
        raise PersistError(f"policy {policy.name!r} needs a goal with {kinds}; this goal has none, give one that has")
    missing = cost.missing()
    if missing:
        raise PersistError(f"cost {cost.name!r}: {missing}")
