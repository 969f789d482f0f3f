"""The results of a benchmark of plans: figures of each row over all episodes and over each kind of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal

import numpy as np

from persist_cli.bench.figure_text import FigureColumn
from persist_cli.bench.plans.plan_bench import PlanningBench
from persist_cli.episodes.episodes import Episode
from persist_cli.episodes.navigation_metrics import SUCCESS_METRES, WalkRecord, soft_spl, way_metres
from persist_cli.episodes.rows import FORGETFUL, NO_MEMORY, POLICY_WALK, RETRIEVAL, SIMULATOR, WALK, PlanningRow
from persist_cli.episodes.stop_rules import AT_PLACE
from persist_cli.episodes.true_scene import TrueScene
from persist_cli.evaluate.provenance import checkpoint_json, environment, weight_hashes, weight_sources
from persist_cli.evaluate.statistics import LEAST_UNITS, RESAMPLES, Draws, Figure, difference, mean_figure
from persist_cli.io.command_line import running_command
from persist_cli.metrics.src import chosen_encoder

FORMAT: Final = "persist-planning"

VERSION: Final = 1


@dataclass(frozen=True)
class Column(FigureColumn):
    """A figure of the tables, of one of the loops.

    Args:
        loop: that it is measured in.
    """

    loop: Literal["closed", "open"]


COLUMNS: Final = {
    "success": Column(
        "success", "higher", True, f"the agent stopped within {SUCCESS_METRES:g} m (geodesic) of the goal", "closed"
    ),
    "spl": Column(
        "SPL", "higher", True, "S · l / max(l, p): S success, l metres of the way of fewest actions, p of its way",
        "closed",
    ),
    "soft_spl": Column(
        "SoftSPL", "higher", True, "max(0, 1 − d / d₀) · l / max(l, p): d metres left, d₀ at the start", "closed"
    ),
    "reached": Column(
        "oracle success", "higher", True,
        f"it was within {SUCCESS_METRES:g} m at any time, as if it were told when to stop", "closed",
    ),
    "wrong_stop": Column("wrong stop", "lower", True, "it stopped farther away than that", "closed"),
    "missed_stop": Column("missed stop", "lower", True, "it was so near and never stopped", "closed"),
    "end_metres": Column("metres left", "lower", False, "geodesic metres to the goal at the end", "closed"),
    "collisions": Column("collisions", "lower", False, "actions that the scene refused, an episode", "closed"),
    "collisions_per_action": Column(
        "collisions/action", "lower", True, "refused actions of an episode by all of its actions, mean over episodes",
        "closed",
    ),
    "actions": Column("actions", None, False, "actions an episode, refused ones included", "closed"),
    "decisions": Column(
        "decisions", None, False,
        "plans and approaches an episode; an approach that stops at once counts too, and imagines nothing", "closed",
    ),
    "frames_per_decision": Column(
        "frames/decision", None, False, "an episode's imagined frames by its decisions, mean over episodes", "closed"
    ),
    "seconds_per_decision": Column(
        "s/decision", "lower", False,
        "an episode's seconds of proposing, imagining and judging by its decisions, mean over episodes", "closed",
    ),
    "writing_per_decision": Column(
        "s/writing", "lower", False,
        "an episode's seconds of writing what was seen to the memory and to the map of the ground by its decisions, "
        "mean over episodes", "closed",
    ),
    "ate": Column("ATE", "lower", False, "root mean square of metres to the shortest way, pose by pose", "open"),
    "rpe": Column("RPE", "lower", False, "the same of translations from one pose to the next, metres", "open"),
    "sim": Column("SIM", "higher", False, "100 · cos(f(v), f(g)): v true view at the plan's end, g goal image", "open"),
    "lpips": Column("LPIPS", "lower", False, "LPIPS-Alex of v and g", "open"),
    "open_collisions": Column("open collisions", "lower", False, "actions of the plan that the scene refused", "open"),
    "open_seconds": Column("s/plan", "lower", False, "seconds that the plan took", "open"),
}  # fmt: skip

NEED_WEIGHTS: Final = ("sim", "lpips")  # columns of networks whose weights may be fetched later


@dataclass(frozen=True)
class Group:
    """Episodes of one kind, which have a table of their own.

    Args:
        name: title of the table.
        bin: of its episodes; ``None`` for all.
        in_sight: of its episodes; ``None`` for both.
        numbers: of its episodes.
    """

    name: str
    bin: int | None
    in_sight: bool | None
    numbers: tuple[int, ...]


def groups(episodes: Sequence[Episode]) -> Iterator[Group]:
    """Yield the kinds of episodes that there are: all, each bin, in sight or hidden, and each of both."""
    bins = sorted({episode.bin for episode in episodes})
    sights = {None: "", True: "in sight", False: "hidden"}
    for number in (None, *bins):
        for sight, words in sights.items():
            chosen = tuple(
                place
                for place, episode in enumerate(episodes)
                if number in (None, episode.bin) and sight in (None, episode.in_sight)
            )
            name = ", ".join(part for part in (f"{number} actions" if number else "", words) if part)
            if chosen:
                yield Group(name or "all episodes", number, sight, chosen)


def results_json(bench: PlanningBench, processes: int) -> dict[str, Any]:
    """Return the results and all that is needed to measure them again, as JSON values."""
    episodes = bench.episodes.episodes
    records = read_records(bench)
    tables = [table_json(group, episodes, bench.rows, records) for group in groups(episodes)]
    return {
        "format": FORMAT,
        "version": VERSION,
        "episodes": {
            "count": len(episodes), "scenes": bench.episodes.scenes, "split": bench.episodes.split,
            "simulator": bench.episodes.simulator, "settings": bench.episodes.settings, "seed": bench.episodes.seed,
            "definitions": bench.episodes.definitions, "names": [episode.name for episode in episodes],
        },
        "settings": settings_json(bench),
        "rows": [row.to_json() | {"definition": define(row, bench)} for row in bench.rows],
        "columns": {name: asdict(column) for name, column in COLUMNS.items()},
        "statistics": {"resamples": RESAMPLES, "least_scenes": LEAST_UNITS, "drawn": "scenes"},
        "tables": tables,
        "checkpoint": None if bench.checkpoint is None else checkpoint_json(bench.checkpoint),
        "environment": environment(processes),
        "command": running_command(),
    }  # fmt: skip


def read_records(bench: PlanningBench) -> dict[str, list[dict[str, Any]]]:
    """Return what happened in every episode, by row; figures that were once defined otherwise are made again."""
    records: dict[str, list[dict[str, Any]]] = {row.name: [] for row in bench.rows}
    for episode in bench.episodes.episodes:
        scene = None
        for row in bench.rows:
            records[row.name].append(record := bench.journal.read(row, episode))
            closed = record["closed"]
            if closed is not None and not bench.cost.sees:
                closed["figures"]["frames_per_decision"] = 0.0  # older persists counted what was judged by its pose
            if closed is not None and "start_metres" not in closed["figures"]:
                scene = scene or TrueScene(bench.simulator, episode)
                closed["figures"] |= measured_again(closed, scene)
    return records


def measured_again(closed: Mapping[str, Any], scene: TrueScene) -> dict[str, float]:
    """Return the figures of a closed loop that an older persist left out or measured otherwise."""
    start, last = (scene.geodesic.metres(tuple(closed["places"][number])) for number in (0, -1))
    end = closed["figures"]["end_metres"]
    end = last if end is None else end  # it was infinite where no free cell lay beside the agent
    walk = WalkRecord([start, end], way_metres(closed["places"]), len(closed["refused"]), stopped=False)
    return {"start_metres": start, "end_metres": end, "soft_spl": soft_spl(walk, scene.episode.metres)}


def settings_json(bench: PlanningBench) -> dict[str, Any]:
    """Return how plans were made and episodes were run, as JSON values."""
    plan, encoder = bench.plan, chosen_encoder()
    sampling = bench.checkpoint.sampling_with(plan.sampling) if bench.checkpoint is not None else None
    return {
        "cost": {"name": bench.cost.name, "settings": asdict(bench.cost.settings), "reads": bench.cost.reads},
        "policy": plan.policy,
        "planning": plan.planning.to_json(),
        "allow_training_scenes": plan.allow_training_scenes,
        "loops": list(plan.loops),
        "loop": asdict(plan.loop),
        "stop": stop_words(bench),
        "sampling": None if sampling is None else asdict(sampling) | plan.placement.changes(),
        "sim": {
            "definition": "SIM = mean over episodes of 100 · cos(f(v), f(g)); f: mean of the patch features of "
            f"{encoder.title} with the final layer norm, images resized to 224 px; v: true view at the end of the plan",
            "weights": weight_hashes([encoder.name]), "sources": weight_sources([encoder.name]),
        },
    }  # fmt: skip


def stop_words(bench: PlanningBench) -> list[str]:
    """Return sentences that say when agents stop."""
    words = [f"an agent that is told the goal's place stops within {AT_PLACE:g} m of it"]
    if bench.thresholds is not None:
        words = [*bench.thresholds.definitions(bench.plan.planning.approach), *words]
    return [*words, "any agent stops when its plan is empty"]


def define(row: PlanningRow, bench: PlanningBench) -> str:
    """Return a few words that say what a row is."""
    given = "given the walk" if row.walk else "given nothing of the scene but its own frames"
    told = f"{'shown the goal image' if row.goal == 'image' else 'told the place of the goal'}, {given}"
    if row.retrieves:
        told = f"shown the goal image; takes for its place that of the frame most like it by {bench.cost.name}; {given}"
    if not row.imagines:
        return f"policy {row.policy!r} without imagination; {told}"
    model = "the simulator itself as the model" if row.memory == SIMULATOR else f"memory {row.memory!r}"
    if row.walk and row.memory in FORGETFUL:
        model += ", which remembers nothing of the walk"
    how = f"ranks {row.candidates} proposals of {row.policy!r}"
    if row.searches:
        cem = bench.plan.planning.cem
        how = f"cross-entropy method, {row.candidates} candidates a round, at most {cem.rounds} rounds"
        how += f", {cem.proposed:.0%} of the first proposed by {row.policy!r}" if row.policy is not None else ""
    return f"{how} by {bench.cost.name}; {model}; {told}"


def table_json(
    group: Group, episodes: Sequence[Episode], rows: Sequence[PlanningRow], records: Mapping[str, Sequence[Any]]
) -> dict[str, Any]:
    """Return the figures of all rows over the episodes of a group, as JSON values."""
    scenes = {scene: number for number, scene in enumerate(dict.fromkeys(episode.scene for episode in episodes))}
    draws = Draws.of([scenes[episodes[number].scene] for number in group.numbers])
    figures = {row.name: row_figures([records[row.name][number] for number in group.numbers], draws) for row in rows}
    return {
        "name": group.name, "bin": group.bin, "in_sight": group.in_sight, "episodes": list(group.numbers),
        "scenes": len({episodes[number].scene for number in group.numbers}),
        "rows": {row.name: row_json(row, rows, figures) for row in rows},
    }  # fmt: skip


def row_figures(records: Sequence[Mapping[str, Any]], draws: Draws) -> dict[str, Figure]:
    """Return the figures of a row by column, of those columns that some episode has.

    Figures that need weights are those of all episodes: some may have been run before the weights were fetched.
    """
    found = {}
    for name, column in COLUMNS.items():
        loops = [record[column.loop] for record in records]
        values = [np.nan if loop is None else loop["figures"].get(name, np.nan) for loop in loops]
        finite = np.array([np.nan if value is None else value for value in values], np.float64)
        known = np.isfinite(finite)
        if known.all() if name in NEED_WEIGHTS else known.any():
            found[name] = mean_figure(finite[None, None], draws)
    return found


def row_json(
    row: PlanningRow, rows: Sequence[PlanningRow], figures: Mapping[str, Mapping[str, Figure]]
) -> dict[str, Any]:
    """Return the figures of a row with its differences to others, as JSON values."""
    others = [other for other in compared_with(row, rows) if other in figures]
    return {
        name: figure.to_json()
        | {
            "differences": {
                other: difference(figure, figures[other][name]) for other in others if name in figures[other]
            }
        }
        for name, figure in figures[row.name].items()
    }


def compared_with(row: PlanningRow, rows: Sequence[PlanningRow]) -> list[str]:
    """Return the names of the rows that a row is compared with.

    They are its planner without memory and with the simulator as the model, and rows without a planner.
    """
    names = [other.name for other in rows]
    alone = next((name for name in ("policy", "random") if name in names), None)
    planner = row.name.partition(",")[0].removesuffix(WALK)
    models = [f"{planner}{WALK}, {NO_MEMORY}", f"{planner}, {NO_MEMORY}", f"{planner}, {SIMULATOR}"]
    wanted = [*models, alone, POLICY_WALK, "shortest-path", RETRIEVAL] if row.imagines else [alone]
    return [name for name in wanted if name is not None and name in names and name != row.name]
