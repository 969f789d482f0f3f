"""``persist bench plan`` from its options to what is measured: all that is checked before, and every episode once."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from persist_cli.api.checkpoint import PLAIN, REFERENCE, Checkpoint, find_checkpoint
from persist_cli.api.cost import Cost
from persist_cli.api.inference import InferenceOptions, SamplingOverrides
from persist_cli.api.policy import Policy
from persist_cli.api.simulator import Simulator
from persist_cli.bench.plans.journal import PlanningJournal, check_row_folders
from persist_cli.checkpoints.contamination import refuse_training_episodes
from persist_cli.checkpoints.load import adapter_memory, checked_sampling, empty_backbone, load_adapter
from persist_cli.checkpoints.placement import check_placement
from persist_cli.episodes.episodes import Episode, EpisodeSet, read_episodes
from persist_cli.episodes.find_episodes import EpisodeSearch
from persist_cli.episodes.make_episodes import draw_episodes
from persist_cli.episodes.navigator import Navigator, PlanSettings, RowParts
from persist_cli.episodes.rows import ALONE, NO_MEMORY, PlanningRow, RowChoice, default_rows
from persist_cli.episodes.run_episode import LoopSettings, run_closed_loop, run_open_loop
from persist_cli.episodes.stop_rules import StopAtPlace, StopByCost, StopRule, StopThresholds, stop_thresholds
from persist_cli.episodes.true_scene import TrueScene
from persist_cli.errors import DataError, PersistError, hint
from persist_cli.evaluate.backbones import BackboneLoader
from persist_cli.evaluate.processes import Processes
from persist_cli.evaluate.provenance import checkpoint_json
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.metrics.src import chosen_encoder
from persist_cli.output.console import add_task, busy, progress
from persist_cli.planning.planners import check_horizon
from persist_cli.plugin_code import code_json
from persist_cli.plugins import make_cost
from persist_cli.policies.open_policy import acting_settings, open_policy
from persist_cli.policies.trained import TrainedPolicy, find_policy, packaged_policy
from persist_cli.simulators.checked import checked_simulator
from persist_cli.simulators.collect import CollectPlan

LOOPS: Final = ("closed", "open")
SCENES: Final = "0:24"  # test houses in which episodes are drawn


@dataclass(frozen=True)
class EpisodeSource:
    """Where episodes come from: a file, or scenes that they are drawn in.

    Args:
        file: of episodes; ``None`` to draw them.
        scenes: to draw them in.
        search: which ones to draw.
        bins: of the file's episodes; ``None`` for all.
    """

    file: Path | None
    scenes: CollectPlan
    search: EpisodeSearch
    bins: tuple[int, ...] | None = None

    @staticmethod
    def of(file: Path | None, scenes: str | None, bins: Sequence[int] | None, each: int | None) -> EpisodeSource:
        """Return where episodes come from, by the options of a command; scenes are test houses of ``miniworld``.

        Args:
            file: of episodes; ``None`` to draw them.
            scenes: ``A:B``, B not included; ``None`` for the usual ones.
            bins: actions of the shortest ways; ``None`` for the file's, or the usual ones.
            each: most drawn episodes of each kind; ``None`` for the usual number.

        Raises:
            PersistError: when it is said what to draw beside a file, which has its episodes.
        """
        if file is not None and (scenes is not None or each is not None):
            raise PersistError("--scenes and --each: of episodes that are drawn, not with --episodes, which has them")
        search = EpisodeSearch(bins=bins or EpisodeSearch.bins, each=EpisodeSearch.each if each is None else each)
        houses = CollectPlan(simulator="miniworld", scenes=scenes or SCENES, split="test")
        return EpisodeSource(file, houses, search, tuple(bins) if bins else None)

    def identity(self, unset: bool = False) -> dict[str, Any]:
        """Return JSON values that are equal for equal episodes.

        Args:
            unset: whether what the file leaves unset counts, too, as in benchmarks that an older persist began. Without
                it a later persist knows the episodes of an earlier one again.

        Raises:
            DataError: when the file is missing or damaged.
        """
        if self.file is None:
            return {"scenes": asdict(self.scenes), "search": asdict(self.search)}
        values = read_episodes(self.file).chosen(self.bins).model_dump(mode="json", exclude_unset=not unset)
        return {"sha256": hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()}

    def episodes(self) -> EpisodeSet:
        """Return the episodes."""
        if self.file is None:
            return draw_episodes(self.scenes, self.search)
        return read_episodes(self.file).chosen(self.bins)


@dataclass(frozen=True, kw_only=True)
class BenchPlan:
    """The options of ``persist bench plan``.

    Args:
        source: of the episodes.
        checkpoint: of the world model.
        rows: names of the rows; ``None`` for the default ones.
        memories: of the world model, and ``simulator``.
        policy: proposes; a name or the folder of a trained one.
        cost: name of the cost.
        planning: how rows plan.
        loops: of ``LOOPS``.
        loop: how episodes are run.
        stop_cost: largest cost of a view at which an agent stops; ``None`` to choose it on validation houses.
        sampling: what the command says of sampling.
        placement: device and precision.
        allow_training_scenes: whether scenes that the model was trained on may be measured.
    """

    source: EpisodeSource
    checkpoint: Path
    rows: tuple[str, ...] | None
    memories: tuple[str, ...]
    policy: str | None
    cost: str
    planning: PlanSettings
    loops: tuple[str, ...]
    loop: LoopSettings
    stop_cost: float | None
    sampling: SamplingOverrides
    placement: InferenceOptions
    allow_training_scenes: bool = False


@dataclass(frozen=True, kw_only=True)
class PlanningBench:
    """A benchmark that was checked and is ready to be run.

    Args:
        plan: the options.
        checkpoint: of the world model; ``None`` where no row has one.
        episodes: to run.
        rows: of the tables.
        policies: of the rows and the plan, by name; ``None`` for no name.
        cost: of the rows that imagine, by which agents that are shown an image stop.
        simulator: of the episodes.
        journal: keeps what was run.
        thresholds: at which such agents stop; ``None`` where the cost reads a place and none is needed.
    """

    plan: BenchPlan
    checkpoint: Checkpoint | None
    episodes: EpisodeSet
    rows: Sequence[PlanningRow]
    policies: Mapping[str | None, Policy | None]
    cost: Cost
    simulator: Simulator
    journal: PlanningJournal
    thresholds: StopThresholds | None

    def stop_rule(self, row: PlanningRow) -> StopRule:
        """Return the rule by which the agents of a row stop."""
        if row.goal == "place" or self.thresholds is None:
            return StopAtPlace()
        approaches = row.imagines and self.plan.planning.approach
        chosen = self.thresholds.approach if approaches else self.thresholds.stop
        return StopByCost(self.cost, chosen.value)

    def units(self, row: PlanningRow, processes: Processes) -> Iterator[Episode]:
        """Yield the episodes of a row that this process runs and the journal lacks."""
        for number, episode in enumerate(self.episodes.episodes):
            if processes.owns(number) and not self.journal.has(row, episode):
                yield episode


def prepare(plan: BenchPlan, out: Path, processes: Processes) -> PlanningBench:
    """Check everything that can be checked before anything is run, and find the episodes.

    Raises:
        PersistError: one line for whatever does not fit.
    """
    check_placement(plan.placement)
    for loop in plan.loops:
        if loop not in LOOPS:
            raise PersistError(f"unknown loop {loop!r}; {hint(loop, LOOPS)}")
    if not plan.loops:
        raise PersistError(f"--loops names no loop; give {' or '.join(LOOPS)}")
    cost = make_cost(plan.cost, {})
    names = plan.rows if plan.rows is not None else default_rows(plan.policy, cost.reads)
    rows = RowChoice(names, plan.memories, plan.policy, cost.reads, plan.planning.cem.candidates).rows()
    if missing := cost.missing():
        raise PersistError(f"cost {cost.name!r}: {missing}")
    policies = open_policies(plan, rows)
    check_policies(rows, policies, plan.planning.horizon)
    check_options(plan, rows, cost)
    check_row_folders(rows)
    uses_model, named = any(row.uses_world_model for row in rows), plan.checkpoint != Path(REFERENCE)
    found = find_checkpoint(plan.checkpoint) if uses_model or named else None
    checkpoint = found if uses_model else None
    if checkpoint is not None:
        check_model(checkpoint, rows, plan.sampling)
    journal = PlanningJournal(out)
    if processes.main:
        values = identity(plan, rows, cost, checkpoint, policies[plan.policy])
        if journal.begun and journal.identity()["episodes"] == plan.source.identity(unset=True):
            values["episodes"] = journal.identity()["episodes"]
        journal.check(values)
        episodes = journal.episodes() if journal.begun else plan.source.episodes()
        if checkpoint is not None:
            check_size(checkpoint, episodes)
        learned = trained_policy(policies[plan.policy])
        refuse_training_episodes(episodes.scenes, checkpoint, learned, plan.allow_training_scenes)
        check_budget(plan, rows, episodes)
        journal.begin(values, episodes)
    processes.wait()
    episodes = journal.episodes()
    simulator = open_simulator(episodes)
    if processes.main:
        find_thresholds(plan, cost, rows, simulator, journal)
    processes.wait()  # the others find what the main process kept
    thresholds = find_thresholds(plan, cost, rows, simulator, journal)
    return PlanningBench(
        plan=plan, checkpoint=checkpoint, episodes=episodes, rows=rows, policies=policies, cost=cost,
        simulator=simulator, journal=journal, thresholds=thresholds,
    )  # fmt: skip


def open_policies(plan: BenchPlan, rows: Sequence[PlanningRow]) -> dict[str | None, Policy | None]:
    """Return the policies of the rows and of the plan by name, each opened once; ``None`` for no name.

    Raises:
        PersistError: when one is not there.
    """
    names = dict.fromkeys([*(row.policy for row in rows), plan.policy])
    return {name: None if name is None else open_policy(name) for name in names}


def check_options(plan: BenchPlan, rows: Sequence[PlanningRow], cost: Cost) -> None:
    """Raise ``PersistError`` when an option has no effect on any row, or is no number that has one."""
    if plan.planning.cem_options and not any(row.searches for row in rows):
        options = ", ".join(plan.planning.cem_options)
        raise PersistError(f"{options}: no row has the cross-entropy method; add cem to --rows, or leave it out")
    if plan.stop_cost is not None and not math.isfinite(plan.stop_cost):
        raise PersistError(f"--stop-cost {plan.stop_cost:g}: give a finite number; at a negative one no agent stops")
    if plan.stop_cost is not None and not stops_by_cost(cost, rows):
        raise PersistError(f"--stop-cost {plan.stop_cost:g}: agents that are told the place of their goal stop there")
    sampled = plan.sampling != SamplingOverrides() or plan.placement != InferenceOptions()
    if sampled and not any(row.uses_world_model for row in rows):
        raise PersistError(
            "how to sample is given, but no row has the world model; add one to --rows and --memories, or leave it out"
        )


def stops_by_cost(cost: Cost, rows: Sequence[PlanningRow]) -> bool:
    """Whether an agent is shown an image of its goal, so that it stops where a view costs little enough."""
    return cost.reads == "image" and any(row.goal != "place" for row in rows)


def check_budget(plan: BenchPlan, rows: Sequence[PlanningRow], episodes: EpisodeSet) -> None:
    """Raise ``PersistError`` when a decision may not imagine as many frames as its longest plan has actions."""
    if not any(row.imagines for row in rows):
        return
    longest = [one.bin for one in episodes.episodes if one.bin <= plan.loop.open_longest and "open" in plan.loops]
    needed, frames = max([plan.planning.horizon, *longest]), plan.planning.frames
    if frames is not None and frames < needed:
        shorter = needed == plan.planning.horizon
        rest = "a shorter --horizon" if shorter else "--loops closed: open loops plan all at once"
        raise PersistError(f"--frames {frames}: a plan has up to {needed} actions; give {needed} or more, or {rest}")


def check_policies(rows: Sequence[PlanningRow], policies: Mapping[str | None, Policy | None], horizon: int) -> None:
    """Raise ``PersistError`` when a policy does not look as far ahead as the horizon, or reads no such goal."""
    for row in rows:
        policy = policies[row.policy]
        check_horizon(policy, horizon)
        if policy is not None and policy.reads and row.goal not in policy.reads and row.name not in ALONE:
            raise PersistError(
                f"policy {row.policy!r} needs a goal with {' or '.join(sorted(policy.reads))}, and the cost reads the "
                f"{row.goal}; take another --cost"
            )


def check_model(checkpoint: Checkpoint, rows: Sequence[PlanningRow], sampling: SamplingOverrides) -> None:
    """Raise ``PersistError`` when the model lacks the adapter of a row, or cannot sample so."""
    checked_sampling(checkpoint, sampling)
    for row in rows:
        if row.uses_world_model and (adapter := adapter_of(checkpoint, row)) is not None:
            adapter_memory(checkpoint, adapter)


def check_size(checkpoint: Checkpoint, episodes: EpisodeSet) -> None:
    """Raise ``DataError`` when the model takes images of another size."""
    size = empty_backbone(checkpoint).image_size
    ours = tuple(episodes.settings.get(side, 64) for side in ("height", "width"))
    if ours != tuple(size):
        raise DataError(
            f"the episodes have images of {ours[0]}x{ours[1]} pixels, {checkpoint.folder} takes {size[0]}x{size[1]}; "
            f"draw episodes with --size {size[0]}x{size[1]}"
        )


def trained_policy(policy: Policy | None) -> TrainedPolicy | None:
    """Return what a policy has learned as it lies on disk; ``None`` for a policy that is not trained."""
    if policy is None or not hasattr(policy.settings, "checkpoint"):
        return None
    checkpoint = policy.settings.checkpoint
    return packaged_policy() if checkpoint is None else find_policy(Path(checkpoint))


def policy_json(name: str | None, policy: Policy | None) -> dict[str, Any] | None:
    """Return JSON values that tell policies apart, and how they act; ``None`` without one."""
    if policy is None:
        return None
    trained = trained_policy(policy)
    return {"name": name, "fingerprint": trained and trained.fingerprint, "settings": acting_settings(policy.settings)}


def open_simulator(episodes: EpisodeSet) -> Simulator:
    """Return the simulator of some episodes.

    Raises:
        PluginError: when it is not installed.
    """
    return checked_simulator(episodes.simulator, episodes.settings)


def find_thresholds(
    plan: BenchPlan, cost: Cost, rows: Sequence[PlanningRow], simulator: Simulator, journal: PlanningJournal
) -> StopThresholds | None:
    """Return the thresholds at which agents that are shown an image stop; ``None`` where there are none."""
    if not stops_by_cost(cost, rows):
        return None
    if plan.stop_cost is not None:
        return StopThresholds.given(plan.stop_cost)
    kept = journal.stop()
    if kept is None:
        with busy("choosing on validation houses when to stop"):
            kept = asdict(stop_thresholds(simulator, cost))
        journal.keep_stop(kept)
    return StopThresholds.read(kept)


def identity(
    plan: BenchPlan, rows: Sequence[PlanningRow], cost: Cost, checkpoint: Checkpoint | None, policy: Policy | None
) -> dict[str, Any]:
    """Return JSON values of all that changes a figure of any row: a benchmark with equal values goes on."""
    sampling = checkpoint.sampling_with(plan.sampling) if checkpoint is not None else None
    searched = any(row.searches for row in rows)
    plugins = [("cost", cost.name)] + ([] if policy is None else [("policy", policy.name)])
    values = {
        "episodes": plan.source.identity(),
        "cost": {"name": cost.name, "settings": asdict(cost.settings)},
        "encoder": chosen_encoder().name if cost.name == "dino" or "open" in plan.loops else None,
        "policy": policy_json(plan.policy, policy),
        "cem candidates": plan.planning.cem.candidates if searched else None,
        "planning": plan.planning.to_json() | ({} if searched else {"rounds": None}),
        "loop": asdict(plan.loop) | {"loops": list(plan.loops)},
        "stop cost": plan.stop_cost,
        "checkpoint": None if checkpoint is None else checkpoint_json(checkpoint),
        "sampling": None if sampling is None else asdict(sampling) | plan.placement.changes(),
        **code_json(*plugins),
    }
    return dict(json.loads(json.dumps(values, default=str)))


def adapter_of(checkpoint: Checkpoint, row: PlanningRow) -> str | None:
    """Return the adapter that a row of the world model uses; ``None`` for the model without one.

    ``none`` is the adapter of that name, or the model without one where there is no such adapter.

    Raises:
        CheckpointError: when the checkpoint has no such adapter.
    """
    if row.memory in (None, PLAIN) or (row.memory == NO_MEMORY and NO_MEMORY not in checkpoint.adapters):
        return None
    return checkpoint.chosen_adapter(row.memory)


class RowLoader:
    """Loads what rows are made of, one backbone for all."""

    def __init__(self, bench: PlanningBench) -> None:
        self.bench, self.loader = bench, BackboneLoader(bench.plan.placement)

    def load(self, row: PlanningRow) -> RowParts:
        """Return the parts of a row; the backbone has its adapter until another row is loaded."""
        checkpoint = self.bench.checkpoint
        parts = RowParts(self.bench.policies[row.policy], self.bench.cost if row.imagines or row.retrieves else None)
        if checkpoint is None or not row.uses_world_model:
            return parts
        backbone, adapter = self.loader.load(checkpoint), adapter_of(checkpoint, row)
        load_adapter(backbone, checkpoint, adapter)
        backbone.prepare_inference(self.bench.plan.placement)
        sampling = checkpoint.sampling_with(self.bench.plan.sampling)
        memory = None if adapter is None else MemoryFactory.of_adapter(checkpoint, adapter, backbone.device)
        return dataclasses.replace(parts, backbone=backbone, factory=memory, sampling=sampling)


def run_rows(bench: PlanningBench, processes: Processes) -> None:
    """Run this process's share of the episodes that the journal does not have yet."""
    todo = [list(bench.units(row, processes)) for row in bench.rows]
    loader = RowLoader(bench)
    with progress() as bar:
        task = add_task(bar, "bench", sum(map(len, todo)), "episodes")
        for row, episodes in zip(bench.rows, todo, strict=True):
            if not episodes:
                continue
            bar.update(task, note=row.name)
            parts = loader.load(row)
            for episode in episodes:
                bench.journal.write(row, episode, run_episode(bench, row, parts, episode))
                bar.advance(task)
    if processes.count > 1:
        with busy("waiting for the other processes"):
            processes.wait()


def run_episode(bench: PlanningBench, row: PlanningRow, parts: RowParts, episode: Episode) -> dict[str, Any]:
    """Run the loops of one episode of one row, and return what happened as JSON values."""
    plan, scene = bench.plan, TrueScene(bench.simulator, episode)
    record: dict[str, Any] = {"row": row.name, "episode": episode.name, "open": None, "closed": None}
    if "open" in plan.loops and episode.bin <= plan.loop.open_longest:
        record["open"] = run_open_loop(scene, Navigator(row, parts, plan.planning, scene, episode.bin))
    if "closed" in plan.loops:
        navigator = Navigator(row, parts, plan.planning, scene, plan.planning.horizon)
        record["closed"] = run_closed_loop(scene, navigator, bench.stop_rule(row), plan.loop)
    return record
