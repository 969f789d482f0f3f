"""The agent of a row: what it knows of the scene, and how it decides."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Final, Literal

import torch

from persist_cli.api.backbone import Backbone, Sampling
from persist_cli.api.cost import Cost
from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.api.policy import Goal, Policy, Situation
from persist_cli.api.simulator import Simulator
from persist_cli.episodes.rows import PlanningRow
from persist_cli.episodes.stop_rules import view_costs
from persist_cli.episodes.true_scene import TrueScene
from persist_cli.errors import PersistError
from persist_cli.io.settings import parse_settings
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.memorize.memory_config import plugin_settings
from persist_cli.navigation.ground_mapper import GroundMapper, body_of
from persist_cli.planning.approach import best_approach
from persist_cli.planning.futures import FutureModel, Over, SimulatorFutures, WorldFutures
from persist_cli.planning.judge import Budget, Judge
from persist_cli.planning.planners import Cem, CemSettings, Planner, Rank, RankSettings
from persist_cli.rollout.seeds import SEEDS, nth_seed
from persist_cli.rollout.world_model import Agent, WorldModel

APPROACH = 8  # actions of the ways that are compared before an agent stops

CEM: Final = CemSettings(candidates=60, rounds=3, shift=0.5)  # of the rows of ``cem``, where nothing else is said

ELSEWHERE: Final = {  # settings of ``cem`` that are not set with ``--set``, and what says them
    "horizon": "give --horizon",
    "candidates": "give --candidates",
    "rounds": "give --rounds",
    "actions": "all rows have the actions of the episodes; leave it out",
}

MANY = 1_000_000  # actions after which nothing is left of a plan

DECISIONS = 100_000  # more than an episode has, so that no two decisions of all episodes share a seed


@dataclass(frozen=True, kw_only=True)
class PlanSettings:
    """How all rows that imagine plan.

    Args:
        horizon: most actions that a decision looks ahead.
        over: which frame of a candidate is judged.
        frames: most imagined frames of a decision; ``None`` for no bound. An approach compares all of its few ways.
        seconds: most seconds of a decision, likewise.
        body: whether imagined moves over ground known to be occupied do not move.
        keep: whether what is left of the last plan is judged again; ``cem`` begins near its distributions, too.
        approach: whether an agent that recognises the goal goes on to the best view before it stops.
        explore: whether plans that end where the agent has looked already come last: the true view from there is known,
            and is not that of the goal image.
        cem: how ``cem`` searches, but for the horizon.
        cem_options: of the command line that say so.

    Raises:
        PersistError: when the bounds of a decision let it imagine nothing.
    """

    horizon: int = 8
    over: Literal["last", "best"] = "last"
    frames: int | None = None
    seconds: float | None = None
    body: bool = True
    keep: bool = True
    approach: bool = True
    explore: bool = True
    cem: CemSettings = CEM
    cem_options: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        Budget(self.frames, self.seconds)  # which refuses what would imagine nothing

    def to_json(self) -> dict[str, Any]:
        """Return JSON values; of ``cem`` only what is not as usual, so that benchmarks begun without it go on."""
        values = asdict(self)
        if self.approach:
            values["approach"] = "straight, else aside"  # once it was straight alone
        cem = values.pop("cem")
        del values["cem_options"]
        changed = {name: value for name, value in cem.items() if value != getattr(CEM, name) and name not in ELSEWHERE}
        return values | {"rounds": self.cem.rounds} | ({"cem": changed} if changed else {})

    def of_cem(
        self, texts: Sequence[str] | None = None, candidates: int | None = None, rounds: int | None = None
    ) -> PlanSettings:
        """Return these settings with others of ``cem``.

        Args:
            texts: such as ``method.elites=0.1``.
            candidates: of a round; ``None`` for the usual ones.
            rounds: most rounds, likewise.

        Raises:
            PersistError: one line for what is no setting of these rows, or cannot be.
        """
        values = plugin_settings(texts or (), ("method",))["method"]
        for name, instead in ELSEWHERE.items():
            if name in values:
                raise PersistError(f"--set method.{name}: {instead}")
        if "shift" in values and not self.keep:
            raise PersistError("--set method.shift: --no-keep begins each plan anew; leave one of them out")
        named = {"candidates": candidates, "rounds": rounds}
        given = {name: value for name, value in named.items() if value is not None}
        cem = parse_settings(CemSettings, asdict(CEM) | values | given, "method 'cem'")
        options = (*(f"--{name}" for name in given), *(f"--set method.{name}" for name in values))
        return replace(self, cem=cem, cem_options=options)


@dataclass(frozen=True)
class RowParts:
    """What a row is made of, loaded once for all episodes.

    Args:
        policy: proposes; ``None`` for ``cem``.
        cost: judges what is imagined, or retrieves; ``None`` for rows that do neither.
        backbone: of the world model, with the row's adapter; ``None`` without one.
        factory: makes the memories that the adapter reads; ``None`` without one.
        sampling: of the world model.
    """

    policy: Policy | None = None
    cost: Cost | None = None
    backbone: Backbone | None = None
    factory: MemoryFactory | None = None
    sampling: Sampling = field(default_factory=Sampling)


@dataclass(frozen=True)
class Decision:
    """What an agent decided.

    Args:
        actions: to do; empty means: stop.
        frames: that were imagined for it.
        seconds: that it took.
    """

    actions: tuple[str, ...]
    frames: int
    seconds: float


class Navigator:
    """An agent at the start of an episode, which has been given what its row is given.

    Args:
        row: the row.
        parts: of that row.
        settings: of planning.
        scene: the true scene; the agent sees its start, goal and walk, and the rows of the simulator plan in it.
        horizon: most actions that a decision looks ahead.
    """

    def __init__(
        self, row: PlanningRow, parts: RowParts, settings: PlanSettings, scene: TrueScene, horizon: int
    ) -> None:
        self.info, self.seed = scene.info, scene.episode.seed
        body = body_of(self.info)
        cost = None if parts.cost is None else parts.cost.fitted(body)
        self.row, self.parts, self.settings = row, replace(parts, cost=cost), settings
        self.seen = scene.look()
        self.looked = [self.seen.cameras.world_from_camera.double().cpu()]
        walk = scene.walk() if row.walk else self.seen[:0]
        self.goal = retrieved(scene.goal, walk, parts.cost) if row.retrieves else told_goal(scene.goal, row)
        self.ground = GroundMapper(self.info.world_up, body)
        self.world = make_world(parts, walk, self.seen, self.info, self.seed)
        self.ground.add(walk)
        self.ground.add(self.seen)
        self.body = body if settings.body else None
        self.simulator = scene.simulator
        self.decisions = 0
        self.writing = 0.0  # seconds of taking in what was seen
        self.least = math.inf  # cost of the best true view since the agent last recognised the goal
        self.decide_once = self._decider(scene.simulator, horizon)

    def saw(self, frames: Observations, executed: int) -> None:
        """Take in the frames after ``executed`` actions: they are written to the memory and to the ground map."""
        begun = time.monotonic()
        kept = self.parts.policy.frames if self.parts.policy is not None else 1
        self.seen = Observations.concatenate([self.seen, frames])[-kept:]
        self.ground.add(frames)
        self.looked.append(frames.cameras.world_from_camera.double().cpu())
        if self.world is not None:
            agent = self.world.agents[0]
            agent.observe(frames)
            agent.memorize(frames, self.world.backbone.device)
        if self.planner is not None:
            self.planner.executed(executed)
        self.ground.map()  # which is kept until something else is seen
        self.writing += time.monotonic() - begun

    def collided(self, frame: Observations, action: str) -> None:
        """Take in that something was in the way of an action: its ground counts as occupied from now on.

        Without it an agent would push for ever against a low thing that hides below its image.

        Args:
            frame: seen where it stands.
            action: that was refused; one that does not walk says nothing.
        """
        forward = self.info.vocabulary[action].forward
        if forward:
            self.ground.add_collision(frame.cameras[0], forward)

    def decide(self) -> Decision:
        """Return the next actions where the goal is not recognised."""
        begun = time.monotonic()
        self.least = math.inf
        generator = torch.Generator().manual_seed(nth_seed(self.seed, self.decisions, DECISIONS))
        situation = Situation(self.seen, self.info, self.goal, self.ground.map())
        self.decisions += 1
        with torch.no_grad():
            actions, frames = self.decide_once(situation, generator)
        return Decision(actions, frames, time.monotonic() - begun)

    @property
    def approaches(self) -> bool:
        """Whether it goes on to the best view of a goal that it recognised; who does not imagine cannot."""
        return self.row.imagines and self.row.goal == "image" and self.settings.approach

    def approach(self) -> Decision:
        """Return the way to the best view nearby of a goal that was recognised; without actions: stop here.

        The agent stops where no imagined view is better than those without a step, and where the last approach did not
        make the true view better.
        """
        begun = time.monotonic()
        situation = Situation(self.seen, self.info, self.goal, self.ground.map())
        judge = self._judge(self._model(self.simulator, situation), situation, "best", Budget())
        now = view_costs(judge.cost, self.seen[-1:], self.goal)[0]
        if now >= self.least:
            return Decision((), 0, time.monotonic() - begun)
        self.least = now
        if self.planner is not None:
            self.planner.executed(MANY)
        with torch.no_grad():
            actions = best_approach(judge, self.info.vocabulary, APPROACH)
        return Decision(actions, judge.frames, time.monotonic() - begun)

    def _decider(
        self, simulator: Simulator, horizon: int
    ) -> Callable[[Situation, torch.Generator], tuple[tuple[str, ...], int]]:
        """Return what decides: a function of situation and generator that gives actions and imagined frames."""
        policy, self.planner = self.parts.policy, None
        if policy is not None and policy.longest is not None:
            horizon = min(horizon, policy.longest)
        if not self.row.imagines:
            return lambda situation, generator: (_first_proposal(policy, situation, horizon, generator), 0)
        planner = self.planner = make_planner(self.row, policy, self.settings, horizon)

        def imagine(situation: Situation, generator: torch.Generator) -> tuple[tuple[str, ...], int]:
            budget = Budget(self.settings.frames, self.settings.seconds)
            judge = self._judge(self._model(simulator, situation), situation, self.settings.over, budget)
            if self.settings.explore and self.row.goal == "image":
                judge.looked = torch.cat(self.looked)
            plan = planner.plan(situation, judge, generator)
            return plan.actions, plan.frames

        return imagine

    def _model(self, simulator: Simulator, situation: Situation) -> FutureModel:
        """Return the model under which candidates are judged."""
        if self.world is None:
            return SimulatorFutures(simulator)
        return WorldFutures(self.world, situation.ground, self.body)

    def _judge(self, model: FutureModel, situation: Situation, over: Over, budget: Budget) -> Judge:
        cost = self.parts.cost
        if cost is None:
            raise ValueError(f"row {self.row.name!r} imagines and has no cost")
        return Judge(model, cost, self.goal, situation.ground, over, budget)


def told_goal(goal: Goal, row: PlanningRow) -> Goal:
    """Return of a goal what a row is told: the image or the place."""
    return Goal(goal.rgb, None, goal.scene) if row.goal == "image" else Goal(None, goal.position, goal.scene)


def retrieved(goal: Goal, walk: Observations, cost: Cost | None) -> Goal:
    """Return the place of the frame of a walk that is most like a goal's image, as the place of the goal."""
    if cost is None:
        raise ValueError("a row that retrieves the goal's place needs a cost")
    costs = view_costs(cost, walk, goal)
    return Goal(None, walk.cameras.centers[costs.index(min(costs))], goal.scene)


def make_world(
    parts: RowParts, walk: Observations, seen: Observations, info: TrajectoryInfo, seed: int
) -> WorldModel | None:
    """Return a world model at the present frame whose memory holds a walk and that frame; ``None`` without one."""
    if parts.backbone is None:
        return None
    memory = None if parts.factory is None else parts.factory.empty(info)
    agent = Agent(memory, seed % SEEDS)
    if len(walk):
        agent.memorize(walk, parts.backbone.device)
    world = WorldModel(parts.backbone, [agent], parts.sampling)
    world.reset([seen], [info])
    return world


def make_planner(row: PlanningRow, policy: Policy | None, settings: PlanSettings, horizon: int) -> Planner:
    """Return the planner of a row that imagines."""
    if row.searches:
        cem = settings.cem if settings.keep else replace(settings.cem, shift=0.0)
        return Cem(replace(cem, horizon=horizon, candidates=row.candidates), policy)
    if policy is None:
        raise ValueError(f"row {row.name!r} ranks and has no policy")
    return Rank(policy, RankSettings(horizon=horizon, candidates=row.candidates, keep=settings.keep))


def _first_proposal(
    policy: Policy | None, situation: Situation, horizon: int, generator: torch.Generator
) -> tuple[str, ...]:
    if policy is None:
        raise ValueError("a row that does not imagine needs a policy")
    return tuple(policy.proposals(situation, horizon, 1, generator)[0])
