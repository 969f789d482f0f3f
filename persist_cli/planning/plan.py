"""``persist plan``: imagine candidates from a start, choose the one that comes nearest to a goal, and show them."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from persist_cli.api.actions import format_actions
from persist_cli.api.checkpoint import Checkpoint, find_checkpoint, reference_checkpoint
from persist_cli.api.cost import Cost
from persist_cli.api.ground import GroundMap
from persist_cli.api.inference import InferenceOptions, SamplingOverrides
from persist_cli.api.observations import Observations, Trajectory, TrajectoryInfo
from persist_cli.api.policy import Goal, Policy, Situation
from persist_cli.checkpoints.lineage import training_scenes
from persist_cli.checkpoints.placement import check_placement
from persist_cli.data.cameras import unfamiliar_view
from persist_cli.data.reference import parse_reference
from persist_cli.errors import PersistError, hint
from persist_cli.io.files import check_folder
from persist_cli.io.settings import parse_settings
from persist_cli.memorize.memory_config import plugin_settings
from persist_cli.navigation.ground_mapper import body_of, knows_floor
from persist_cli.output.console import add_task, busy, print_json, print_table, progress, say, warn
from persist_cli.planning.futures import Over, WorldFutures
from persist_cli.planning.goal import check_near, read_goal
from persist_cli.planning.judge import Budget, Judge, check_goal
from persist_cli.planning.outputs import Planned, write_plan
from persist_cli.planning.planners import Cem, CemSettings, OnRound, Plan, Rank, RankSettings, action_names
from persist_cli.plugins import make_cost
from persist_cli.policies.open_policy import open_policy
from persist_cli.rollout.camera_path import walking_vocabulary
from persist_cli.rollout.open_world import WorldOptions, assemble_world
from persist_cli.rollout.surroundings import Surroundings
from persist_cli.rollout.world_model import Agent, WorldModel

METHODS = {"rank": "keep", "cem": "shift"}  # with the setting of each that a single plan has no use for
OVER: dict[str, Over] = {"last": "last", "best": "best"}
SHOWN = 5  # candidates in the terminal's table and on the sheet


@dataclass(frozen=True, kw_only=True)
class PlanOptions:
    """The options of ``persist plan``; see its help.

    ``candidates``, ``rounds`` and ``horizon`` are ``None`` for the method's own, ``policy`` for ``random`` and ``cost``
    for ``lpips``, or ``geodesic`` where the goal is a place. ``body`` says whether walls stop the
    agent; ``None``: where the height of its camera is told, see ``tells_body``.
    """

    start: str
    goal: str
    memory: Path | None = None
    adapter: str | None = None
    method: str = "cem"
    policy: str | None = None
    cost: str | None = None
    over: str = "last"
    horizon: int | None = None
    candidates: int | None = None
    rounds: int | None = None
    actions: tuple[str, ...] = ()
    frames: int | None = None
    seconds: float | None = None
    batch: int = 20
    body: bool | None = None
    seed: int = 0
    settings: tuple[str, ...] = ()
    sampling: SamplingOverrides = field(default_factory=SamplingOverrides)
    placement: InferenceOptions = field(default_factory=InferenceOptions)
    step: float | None = None
    turn: float | None = None

    @property
    def world(self) -> WorldOptions:
        """Those of the options that a world model is put together with."""
        return WorldOptions(
            start=self.start, memory=self.memory, adapter=self.adapter, seed=self.seed, sampling=self.sampling,
            placement=self.placement, body=self.body,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class PlanParts:
    """What a plan is made with, checked before a model is loaded.

    Args:
        start: the start frame.
        seen: the frames of its trajectory up to it, as many as the policy looks at.
        goal: what is looked for.
        planner: the method.
        policy: proposes candidates; ``None`` where the method needs none.
        cost: judges them.
        budget: the most that may be spent.
        over: which frame is judged.
    """

    start: Trajectory
    seen: Observations
    goal: Goal
    planner: Rank | Cem
    policy: Policy | None
    cost: Cost
    budget: Budget
    over: Over


def run_plan(path: Path | None, options: PlanOptions, out: Path, as_json: bool) -> None:
    """Plan with a checkpoint, or the reference model without a path, and write what was found to a folder."""
    check_placement(options.placement)  # a missing accelerator is an error before anything is loaded
    checkpoint = find_checkpoint(path or reference_checkpoint())
    adapter = checkpoint.chosen_adapter(options.adapter)
    check_folder(out)
    parts = plan_parts(options)
    view = unfamiliar_view([parts.start.info], training_scenes(checkpoint))
    if view is not None:
        warn(f"warning: {view}")
    model = open_model(checkpoint, adapter, options, parts.start)
    with torch.no_grad():
        planned = make_plan(model, parts, options)
        with busy("writing sheet, map and video"):
            record = write_plan(planned, out, describe(checkpoint, adapter, options, parts, model), SHOWN)
    if as_json:
        print_json(record)
        return
    show(planned, record, out)


def plan_parts(options: PlanOptions) -> PlanParts:
    """Return goal, method, policy and cost of the options, and the start frame.

    Raises:
        PersistError: one line for the first of them that cannot be used.
    """
    reference = parse_reference(options.start)
    file = reference.single()
    vocabulary = walking_vocabulary(file, options.start, options.step, options.turn)
    start = file.read([reference.frame])
    start = dataclasses.replace(start, info=dataclasses.replace(start.info, vocabulary=vocabulary))
    budget = Budget(options.frames, options.seconds)
    if options.over not in OVER:
        raise PersistError(f"unknown --over {options.over!r}; {hint(options.over, OVER)}")
    settings = plugin_settings(options.settings, ("method", "policy", "cost"))
    policy = chosen_policy(options, settings["policy"])
    planner = chosen_planner(options, policy, settings["method"])
    action_names(vocabulary, options.actions)
    goal = read_goal(options.goal, start.observations, start.info)
    name = options.cost or ("lpips" if goal.rgb is not None else "geodesic")
    cost = make_cost(name, settings["cost"]).fitted(body_of(start.info))
    check_goal(goal, cost, policy)
    first = max(0, reference.frame + 1 - (policy.frames if policy is not None else 1))
    seen = file.read(range(first, reference.frame + 1)).observations
    return PlanParts(
        start=start, seen=seen, goal=goal, planner=planner, policy=policy, cost=cost, budget=budget,
        over=OVER[options.over],
    )  # fmt: skip


def chosen_policy(options: PlanOptions, settings: dict[str, Any]) -> Policy | None:
    """Return the policy that proposes; ``None`` for a method that needs none, where none is named."""
    if options.method == "rank" or options.policy is not None:
        return open_policy(options.policy or "random", settings)
    if settings:
        raise PersistError(f"--set policy.{next(iter(settings))}: no policy proposes here; name one with --policy")
    return None


def chosen_planner(options: PlanOptions, policy: Policy | None, settings: dict[str, Any]) -> Rank | Cem:
    """Return the method with the settings of the options.

    Raises:
        PersistError: for an unknown method, settings that are wrong or act between plans, or a policy that does not
            look so far ahead.
    """
    if options.method not in METHODS:
        raise PersistError(f"unknown --method {options.method!r}; {hint(options.method, METHODS)}")
    if options.actions and options.method != "cem":
        raise PersistError("--actions are those that --method cem chooses from; a policy has its own")
    if (between := METHODS[options.method]) in settings:
        raise PersistError(
            f"--set method.{between} acts between one plan and the next, and this command makes one; leave it out, or "
            "see `persist bench plan`"
        )
    named = {"horizon": options.horizon, "candidates": options.candidates, "rounds": options.rounds}
    given = settings | {name: value for name, value in named.items() if value is not None}
    if options.actions:
        given["actions"] = list(options.actions)
    if options.method == "cem" or policy is None:
        return Cem(parse_settings(CemSettings, given, "method 'cem'"), policy)
    return Rank(policy, parse_settings(RankSettings, given, "method 'rank'"))


def open_model(checkpoint: Checkpoint, adapter: str | None, options: PlanOptions, start: Trajectory) -> WorldModel:
    """Return the world model with its agent at the start frame."""
    model = assemble_world(checkpoint, adapter, options.world, start.info)
    model.reset([start.observations], [start.info])
    return model


def make_plan(model: WorldModel, parts: PlanParts, options: PlanOptions) -> Planned:
    """Plan from the start frame, with a progress bar that shows each round's best cost."""
    agent, info = model.agents[0], parts.start.info
    ground = known_ground(agent, info)
    check_near(options.goal, parts.goal, agent, ground)
    futures = WorldFutures(model, ground, agent.body)
    judge = Judge(futures, parts.cost, parts.goal, ground, parts.over, parts.budget, options.batch)
    situation = Situation(parts.seen, info, parts.goal, ground)
    generator = torch.Generator().manual_seed(options.seed)
    with shown_progress(parts, judge) as on_round:
        plan = parts.planner.plan(situation, judge, generator, on_round)
    return Planned(plan, parts.goal, parts.cost, ground, futures)


def known_ground(agent: Agent, info: TrajectoryInfo) -> GroundMap:
    """Return what an agent knows of the ground: nothing where nobody knows how far below its camera the floor lies."""
    if not knows_floor(info, agent.body):
        return GroundMap.empty(info.world_up)
    return Surroundings(body_of(info), agent.now, info, agent.memory).map()


@contextmanager
def shown_progress(parts: PlanParts, judge: Judge) -> Iterator[OnRound]:
    """Show within the block how many frames are imagined or poses judged, and the best cost after each round."""
    settings = parts.planner.settings
    total = settings.rounds * settings.candidates * settings.horizon
    if parts.budget.frames is not None:
        total = min(total, parts.budget.frames)
    with progress() as bar:
        unit = "frames" if parts.cost.sees else "actions"
        task = add_task(bar, "planning", total, unit, f"round 1 of {settings.rounds}")
        judge.on_batch = lambda actions: bar.update(task, advance=actions)

        def on_round(number: int, cost: float) -> None:
            bar.update(task, note=f"round {number} of {settings.rounds}, best cost {cost:.4g}")

        yield on_round
        bar.update(task, completed=total)


def describe(
    checkpoint: Checkpoint, adapter: str | None, options: PlanOptions, parts: PlanParts, model: WorldModel
) -> dict[str, Any]:
    """Return JSON values that suffice to repeat the plan."""
    settings = dataclasses.asdict(parts.planner.settings)
    policy = parts.policy and {"name": parts.policy.name, "settings": dataclasses.asdict(parts.policy.settings)}
    return {
        "format": "persist-plan",
        "version": 1,
        "checkpoint": str(checkpoint.folder),
        "fingerprint": checkpoint.fingerprint,
        "adapter": adapter,
        "memory": options.memory and str(options.memory),
        "start": options.start,
        "goal": {
            "text": options.goal,
            "kinds": sorted(parts.goal.kinds),
            "position": None if parts.goal.position is None else parts.goal.position.tolist(),
        },
        "scene": parts.start.info.scene,
        "method": {"name": options.method, "settings": settings},
        "policy": policy,
        "cost": {"name": parts.cost.name, "settings": dataclasses.asdict(parts.cost.settings), "over": options.over},
        "budget": dataclasses.asdict(parts.budget),
        "step": options.step,
        "turn": options.turn,
        "batch": options.batch,
        "body": model.agents[0].body is not None,
        "seed": options.seed,
        "sampling": dataclasses.asdict(model.sampling),
        "placement": dataclasses.asdict(options.placement),
    }


def cells(candidate: dict[str, Any]) -> list[str]:
    """Return what the terminal's table says of a candidate of ``plan.json``."""
    true_cost = "" if candidate["true_cost"] is None else f"{candidate['true_cost']:.4f}"
    stopped = ", ".join(map(str, candidate["blocked"]))
    return [
        f"{candidate['cost']:.4f}",
        true_cost,
        str(candidate["round"]),
        stopped,
        candidate["actions"] or "stay here",
    ]


def show(planned: Planned, record: dict[str, Any], out: Path) -> None:
    """Print the best candidates and what was chosen."""
    best: list[dict[str, Any]] = record["candidates"][:SHOWN]
    rows = [[str(number), *cells(candidate)] for number, candidate in enumerate(best, 1)]
    plan: Plan = planned.plan
    title = f"the best {len(rows)} of {len(plan.candidates)} candidates"
    print_table(title, ["rank", "cost", "true cost", "round", "blocked", "actions"], rows)
    rounds = "1 round" if plan.rounds == 1 else f"{plan.rounds} rounds"
    say(f"chosen: {format_actions(plan.actions) or 'stay here'}")
    what = f"{len(plan.candidates)} videos, {plan.frames} imagined frames"
    if not planned.cost.sees:
        what = f"{len(plan.candidates)} candidates of {plan.judged} actions, judged by their poses alone,"
    say(
        f"{what} in {plan.seconds:.1f} s ({rounds}{', ended by the budget' if plan.exhausted else ''}), "
        f"{planned.futures.model.sampling.words}; written to {out}"
    )
    unknown = record["truth"]["unknown"]
    if unknown:
        say(f"what is really there is left out: {unknown}")
