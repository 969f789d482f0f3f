"""The part "evolution" of the benchmark: whether cells become what they truly become when an agent acts.

Agents of the data pick things up, put them down and toggle them. A scene holds the true cells just before, and the
frame that the agent sees then. It is acted on from the same pose, and the cells that change are compared with those
that truly do. What is put down was picked up before. The rules do that, in every row, so that the hands hold the true
thing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from persist_cli.api.cells import CellGrid
from persist_cli.api.scene import Scene
from persist_cli.bench.figure_text import FigureColumn
from persist_cli.bench.scenes.class_counts import share_figure
from persist_cli.bench.scenes.completions import Scenes
from persist_cli.bench.scenes.interactions import Event
from persist_cli.bench.scenes.scene_bench import SceneBench
from persist_cli.bench.scenes.untold import Untold
from persist_cli.bench.scenes.views import same_form
from persist_cli.data.scene_truth import PICK_UP
from persist_cli.data.store import TrajectoryFile
from persist_cli.evaluate.statistics import Draws, mean_figure
from persist_cli.navigation.ground_mapper import body_of
from persist_cli.output.console import add_task, progress, warn

PART: Final = "evolution"

NEAR: Final = 48  # of 255, by which a channel of a right colour differs at most

COLUMNS: Final = {
    "iou": FigureColumn(
        "IoU of changed cells", "higher", True,
        "cells that change and truly do, of all that do one or the other; counts are added over all interactions",
    ),
    "right": FigureColumn(
        "right", "higher", True,
        "share of the cells that truly change which then hold their true class, in a colour of which no channel is "
        f"more than {NEAR} of 255 off",
    ),
    "false": FigureColumn("false changes", "lower", False, "cells an interaction that change and truly do not"),
    "true": FigureColumn("true changes", None, False, "cells an interaction that truly change"),
    "done": FigureColumn("done", "higher", True, "share of interactions that the scene allows; in truth all were done"),
}  # fmt: skip


@dataclass(frozen=True)
class EvolutionRow:
    """A way to say what becomes of cells.

    Args:
        name: of the row.
        evolution: what the scene's setting ``evolution`` is; ``None`` where nothing ever changes.
        definition: what it says, as a sentence without a full stop.
    """

    name: str
    evolution: str | None
    definition: str

    @property
    def part(self) -> str:
        """Its name in the journal."""
        return f"{PART} {self.name}"


MODEL: Final = EvolutionRow("model", "model", "the scene model, from the true cells before")

UNTOLD: Final = EvolutionRow(
    "model, not told", "model",
    "the same without the action: what it would change for no reason. It still knows which cells may change, and what "
    "is carried. A share of the training samples of stage scene-outcome are such (outcome.drop_action), none of others",
)  # fmt: skip

RULES: Final = EvolutionRow("rules", "rules", "the rules of the memory, from the same cells")

NOTHING: Final = EvolutionRow("nothing", None, "no cell changes")


def evolution_rows(bench: SceneBench) -> list[EvolutionRow]:
    """Return the rows; those of the model only where there is one."""
    return [RULES, NOTHING] if bench.trained is None else [MODEL, UNTOLD, RULES, NOTHING]


def chosen_events(bench: SceneBench) -> Sequence[Event]:
    """Return the interactions that are measured: those of the benchmark that the model knows, if there is a model."""
    if bench.trained is None:
        return bench.events
    known = bench.trained.form.actions
    return [event for event in bench.events if event.action in known]


def row_seeds(bench: SceneBench, row: EvolutionRow) -> range:
    """Return the seeds of a row; only a model draws anything."""
    return range(bench.plan.seeds if row.evolution == "model" else 1)


def run_evolution(bench: SceneBench) -> None:
    """Do every interaction in every row, but those that the journal has."""
    events = chosen_events(bench)
    units = [
        (row, event, seed)
        for row in evolution_rows(bench)
        for event in events
        for seed in row_seeds(bench, row)
        if not bench.journal.has(row.part, unit_name(event, seed))
    ]
    with progress() as bar:
        task = add_task(bar, "acting in scenes", len(units), "interactions")
        for row, event, seed in units:
            bar.update(task, note=row.name)
            bench.journal.write(row.part, unit_name(event, seed), judge(bench, row, event, seed))
            bar.advance(task)


def unit_name(event: Event, seed: int) -> str:
    """Return the name of an interaction in the journal."""
    return f"{event.name} seed {seed}"


def judge(bench: SceneBench, row: EvolutionRow, event: Event, seed: int) -> dict[str, Any]:
    """Do an interaction and return what changes, as JSON values; nothing where its thing is not in the hands."""
    record: dict[str, Any] = {"scene": event.file.info.scene, "action": event.action}
    scenes = with_evolution(bench.scenes.seeded(seed), row.evolution or "rules")
    if row == UNTOLD and scenes.model is not None:
        scenes = replace(scenes, model=Untold(scenes.model))
    before, truth = (event.file.cells(event.frame + later) for later in (0, 1))
    scene = scene_before(scenes, event, before)
    if scene is None:
        return record | {"counts": None}
    done = row.evolution is not None and act(scene, event.file, event.frame, event.action)
    after = same_form(scene.cells.box(truth.corner, truth.shape), truth.form, "the scene") if done else before
    return record | {"counts": change_counts(before, after, truth) | {"done": float(done)}}


def with_evolution(scenes: Scenes, evolution: str) -> Scenes:
    """Return the same scenes, which evolve by the model or by rules."""
    return replace(
        scenes, factory=replace(scenes.factory, settings=replace(scenes.factory.settings, evolution=evolution))
    )


def scene_before(scenes: Scenes, event: Event, cells: CellGrid) -> Scene | None:
    """Return a scene just before an interaction; ``None`` where the rules do not pick up what it puts down.

    Args:
        scenes: evolve by the model or by rules.
        event: the interaction.
        cells: the true ones before it.
    """
    scene = scenes.empty(event.file.info)
    if event.taken is not None:
        hands = carrying(with_evolution(scenes, "rules"), event.file, event.taken)
        if hands is None:
            return None
        scene.restore(hands)
    scene.memorize(event.file.read([event.frame]).observations.to(scenes.factory.device))
    scene.add(cells)
    return scene


def carrying(scenes: Scenes, file: TrajectoryFile, taken: int) -> dict[str, Tensor] | None:
    """Return the content of a scene in which a thing was picked up at a frame; ``None`` where the rules take another.

    Args:
        scenes: evolve by rules.
        file: the trajectory.
        taken: the frame before.
    """
    before, truth = (file.cells(taken + later) for later in (0, 1))
    scene = scenes.empty(file.info)
    scene.add(before)
    act(scene, file, taken, PICK_UP)
    after = scene.cells.box(truth.corner, truth.shape)
    same = torch.equal(before.solid & ~after.solid, before.solid & ~truth.solid)
    return scene.tensors() if same else None


def act(scene: Scene, file: TrajectoryFile, frame: int, action: str) -> bool:
    """Let a scene evolve by what the agent of a trajectory does at a frame; whether it allowed it."""
    info = file.info
    return scene.act(info.vocabulary[action], file.poses()[frame].double(), body_of(info))


def change_counts(before: CellGrid, after: CellGrid, truth: CellGrid) -> dict[str, int]:
    """Return how many cells change, truly change, do both, and of the true ones are right afterwards."""
    said, true = changed(before, after), changed(before, truth)
    off = (after.colors.int() - truth.colors.int()).abs().amax(-1)
    right = (after.classes == truth.classes) & (~truth.solid | (off <= NEAR))
    counts = {"said": said, "true": true, "both": said & true, "right": true & right, "false": said & ~true}
    return {name: int(cells.sum()) for name, cells in counts.items()}


def changed(before: CellGrid, after: CellGrid) -> Bool[Tensor, "first second level"]:
    """Return which cells of two grids of one box have another class, or are solid in another colour."""
    repainted = before.solid & after.solid & (before.colors != after.colors).any(-1)
    return (before.classes != after.classes) | repainted


def evolution_json(bench: SceneBench) -> dict[str, Any]:
    """Return the figures of all rows, over all interactions and over each kind, as JSON values."""
    events = chosen_events(bench)
    rows = {row.name: row_records(bench, row, events) for row in evolution_rows(bench)}
    kept = [place for place, record in enumerate(rows[RULES.name][0]) if record["counts"] is not None]
    if len(kept) < len(events):
        warn(f"{len(events) - len(kept)} of {len(events)} interactions are left out: the rules do not take their thing")
    groups = {"all": kept}
    for action in dict.fromkeys(events[place].action for place in kept):
        groups[action] = [place for place in kept if events[place].action == action]
    return {
        "columns": {name: column.definition for name, column in COLUMNS.items()},
        "definitions": {row.name: row.definition for row in evolution_rows(bench)},
        "interactions": len(events),
        "left_out": len(events) - len(kept),
        "rows": {
            name: {group: event_figures(records, places) for group, places in groups.items() if places}
            for name, records in rows.items()
        },
    }


def row_records(bench: SceneBench, row: EvolutionRow, events: Sequence[Event]) -> list[list[dict[str, Any]]]:
    """Return the journal's records ``[seed][event]`` of a row."""
    return [
        [bench.journal.read(row.part, unit_name(event, seed)) for event in events] for seed in row_seeds(bench, row)
    ]


def event_figures(records: Sequence[Sequence[dict[str, Any]]], places: Sequence[int]) -> dict[str, Any]:
    """Return the figures of some interactions, and their number, as JSON values.

    Args:
        records: ``[seed][event]``.
        places: numbers of the events.
    """
    chosen = [[of_seed[place] for place in places] for of_seed in records]
    draws = Draws.of_scenes(record["scene"] for record in chosen[0])

    def count(name: str) -> np.ndarray[Any, Any]:
        return np.array([[record["counts"][name] for record in of_seed] for of_seed in chosen], dtype=np.float64)

    figures = {
        "iou": share_figure(count("both"), count("said") + count("true") - count("both"), draws),
        "right": share_figure(count("right"), count("true"), draws),
        "false": mean_figure(count("false")[None], draws),
        "true": mean_figure(count("true")[None], draws),
        "done": mean_figure(count("done")[None], draws),
    }
    return {name: figure.to_json() for name, figure in figures.items()} | {"count": len(places)}
