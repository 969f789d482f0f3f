"""The rows of the benchmark of plans: what decides, what it imagines with, and what it is told."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal

from persist_cli.api.checkpoint import PLAIN
from persist_cli.api.policy import GoalKind
from persist_cli.errors import PersistError, hint

SIMULATOR: Final = "simulator"  # in place of a memory: the simulator itself is the model

NO_MEMORY: Final = "none"

FORGETFUL: Final = (NO_MEMORY, PLAIN)  # models that remember nothing, whose agents are not given the walk

POLICY: Final = "policy"  # the row of the policy that ``--policy`` names, without imagination

POLICY_WALK: Final = "policy-walk"  # the same, given the walk, so that it knows as much ground as rows with a memory

RETRIEVAL: Final = "shortest-path-retrieval"  # to the place of the given frame that is most like the goal image

CEM_POLICY: Final = "cem-policy"  # ``cem`` whose first round the policy begins

POLICIES: Final = (POLICY, POLICY_WALK)

WALK: Final = "-walk"  # ends the names of rows that are given the walk for the ground that it shows

IMAGINING: Final = re.compile(r"(?P<planner>rank-(?P<count>[1-9]\d*)|cem|cem-policy)(?P<walk>-walk)?")
"""Names of rows that imagine. With ``-walk`` the agent knows the ground of the walk, and the model remembers nothing of
it: the difference to a row with a memory is what the model's memory is worth."""

Planning = Literal["policy", "rank", "cem"]


@dataclass(frozen=True, kw_only=True)
class PlanningRow:
    """One row of the tables.

    Args:
        name: unique among the rows.
        planner: ``policy`` follows the first proposal of a policy, ``rank`` and ``cem`` imagine candidates.
        policy: name or folder of the policy that proposes; ``None`` for ``cem``.
        memory: of the world model, or ``simulator`` for the simulator in its place; ``None`` without a model.
        goal: what it is told of the goal.
        walk: whether it is given the walk: its frames go into the memory, and its ground into what the agent knows.
        candidates: that a round imagines; 0 without a model.
        retrieves: whether the place that it is told is that of the given frame most like the goal image, by the cost.
    """

    name: str
    planner: Planning
    policy: str | None
    memory: str | None
    goal: GoalKind
    walk: bool
    candidates: int = 0
    retrieves: bool = False

    @property
    def imagines(self) -> bool:
        """Whether a model judges candidates."""
        return self.planner != "policy"

    @property
    def searches(self) -> bool:
        """Whether it has the cross-entropy method."""
        return self.planner == "cem"

    @property
    def uses_world_model(self) -> bool:
        """Whether that model is the checkpoint's."""
        return self.imagines and self.memory != SIMULATOR

    def to_json(self) -> dict[str, Any]:
        """Return the row as JSON values."""
        return asdict(self)


ALONE: Final[dict[str, tuple[str, GoalKind | None, bool]]] = {
    "random": ("random", None, False),
    "straight": ("straight", None, False),
    "shortest-path": ("shortest-path", "place", True),
    "shortest-path-no-walk": ("shortest-path", "place", False),
    "shortest-path-image": ("shortest-path", "image", True),
    "shortest-path-image-no-walk": ("shortest-path", "image", False),
    RETRIEVAL: ("shortest-path", "place", True),
}
"""Rows without imagination: the policy, what it is told of the goal (``None``: what the cost reads), and whether it is
given the walk."""

PLANNED: Final = ("rank-8", "rank-16", "cem")


def default_rows(policy: str | None, goal: GoalKind) -> tuple[str, ...]:
    """Return the names of the rows where none are named."""
    alone = [name for name, (_, told, _) in ALONE.items() if told in (None, "place", goal)]
    alone = [name for name in alone if name != RETRIEVAL or goal == "image"]
    return (*alone, *([POLICY] if policy else []), *PLANNED)


@dataclass(frozen=True)
class RowChoice:
    """What the rows are made of.

    Args:
        names: of ``ALONE``, of ``POLICIES``, ``rank-N``, ``cem`` or ``cem-policy``; with ``-walk`` behind one of the
            last three the model without memory is given the walk's ground.
        memories: of the world model, and ``simulator``; each makes a row of every ``rank-N`` and of ``cem``.
        policy: name or folder of the policy of ``policy`` and ``rank-N``; ``None`` where none is named, which ranks
            ``random``.
        goal: what the cost reads.
        cem_candidates: candidates of a round of ``cem``.
    """

    names: Sequence[str]
    memories: Sequence[str]
    policy: str | None
    goal: GoalKind
    cem_candidates: int

    def rows(self) -> list[PlanningRow]:
        """Return the rows in order, each once.

        Raises:
            PersistError: for an unknown name, no row, no memory where one is needed, or ``policy`` without a policy.
        """
        names, memories = list(dict.fromkeys(self.names)), list(dict.fromkeys(self.memories))
        for name in names:
            if name not in (*ALONE, *POLICIES) and not IMAGINING.fullmatch(name):
                raise PersistError(f"unknown row {name!r}; {hint(name, [*ALONE, *POLICIES, *PLANNED, CEM_POLICY])}")
            if self.goal == "place" and (name == RETRIEVAL or ALONE.get(name, ("", "", False))[1] == "image"):
                raise PersistError(f"row {name!r} is shown the goal image, and the cost reads a place; leave it out")
        alone = next((name for name in names if name in POLICIES or name.startswith(CEM_POLICY)), None)
        if alone is not None and self.policy is None:
            raise PersistError(f"the row {alone!r} needs a policy; give --policy a name or the folder of a trained one")
        rows = [row for name in names for row in self._rows_of(name, memories)]
        if not rows:
            raise PersistError("no row is left; name --rows such as random,rank-8 and --memories such as none,voxel")
        return rows

    def _rows_of(self, name: str, memories: Sequence[str]) -> Iterator[PlanningRow]:
        if name in POLICIES:
            yield PlanningRow(
                name=name, planner="policy", policy=self.policy, memory=None, goal=self.goal, walk=name == POLICY_WALK
            )
        elif name in ALONE:
            alone, goal, walk = ALONE[name]
            yield PlanningRow(
                name=name, planner="policy", policy=alone, memory=None, goal=goal or self.goal, walk=walk,
                retrieves=name == RETRIEVAL,
            )  # fmt: skip
        elif named := IMAGINING.fullmatch(name):
            yield from self._imagining(named, memories)

    def _imagining(self, named: re.Match[str], memories: Sequence[str]) -> Iterator[PlanningRow]:
        """Yield the rows of a name that imagines: one for each memory, or for each model that remembers nothing."""
        count = int(named["count"] or self.cem_candidates)
        led = self.policy if named["planner"] == CEM_POLICY else None
        policy = (self.policy or "random") if named["count"] else led
        given = [memory for memory in memories if not named["walk"] or memory in FORGETFUL]
        if not given:
            raise PersistError(
                f"row {named[0]!r} is of a model that remembers nothing, as other memories are given the walk anyway; "
                f"add {NO_MEMORY} to --memories"
            )
        planner: Planning = "rank" if named["count"] else "cem"
        for memory in given:
            walk = named["walk"] is not None or memory not in FORGETFUL
            yield PlanningRow(
                name=f"{named[0]}, {memory}", planner=planner, policy=policy, memory=memory, goal=self.goal, walk=walk,
                candidates=count,
            )  # fmt: skip
