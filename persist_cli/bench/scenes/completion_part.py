"""The part "completion" of the benchmark: what each row says is in the cells that one image does not show."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from persist_cli.api.cell_things import STRUCTURE
from persist_cli.bench.figure_text import FigureColumn
from persist_cli.bench.scenes.class_counts import class_counts, iou_figure, share_figure, things
from persist_cli.bench.scenes.completions import CEILINGS, Completion
from persist_cli.bench.scenes.connectedness import LEAST_GROUND, MARGIN, count_borders, count_doors
from persist_cli.bench.scenes.layouts import NEIGHBOUR, PLAN, disagreement, distinct, plan_features, precision_recall
from persist_cli.bench.scenes.scene_bench import SceneBench
from persist_cli.bench.scenes.training_houses import House
from persist_cli.bench.scenes.views import Region, View, sampled, true_region
from persist_cli.evaluate.statistics import Draws, Figure, difference, mean_figure, number
from persist_cli.output.console import add_task, progress

PART: Final = "completion"

UNSEEN: Final = "cells that are unknown after the image and within the radius of the camera along the ground"

COLUMNS: Final = {
    "miou": FigureColumn(
        "mIoU", "higher", True,
        f"mean over the classes of things that the truth has of intersection over union of {UNSEEN}; counts are added "
        "over houses first; free and outside are no things", digits=1,
    ),
    "structure": FigureColumn(
        "mIoU of structure", "higher", True, f"the same over those of {', '.join(STRUCTURE)} alone", digits=1
    ),
    "iou": FigureColumn("IoU", "higher", True, "the same of being occupied: neither free nor outside"),
    "free_iou": FigureColumn("free IoU", "higher", True, "the same of the class free"),
    "outside_iou": FigureColumn("outside IoU", "higher", True, "the same of the class outside"),
    "doors": FigureColumn("doors", None, False, f"doors an image that it does not show, {MARGIN:g} m from the border"),
    "leading": FigureColumn(
        "doors that lead", "higher", True,
        f"share of these through which an agent walks from {LEAST_GROUND:g} m² of places for its middle to as many",
    ),
    "passable": FigureColumn("passable doors", "higher", True, "share of these through which an agent fits"),
    "open": FigureColumn(
        "open walls", "lower", True,
        "of the faces between free cells and walls, or cells outside, side by side, the share that is outside",
    ),
    "distinct": FigureColumn("distinct", None, False, "different samples of an image"),
    "disagreement": FigureColumn("disagreement", None, True, f"share of {UNSEEN} in which two samples differ"),
    "precision": FigureColumn(
        "precision", "higher", True,
        f"share of layouts within the distance of a training layout to its {NEIGHBOUR}rd neighbour; {PLAN}",
    ),
    "recall": FigureColumn(
        "recall", "higher", True, f"share of training layouts as near to a row's as its {NEIGHBOUR}rd neighbour"
    ),
    "coverage": FigureColumn(
        "coverage", "higher", True, f"share of training layouts with one of a row's before the {NEIGHBOUR}rd neighbour"
    ),
    "seconds": FigureColumn("s/image", "lower", False, "seconds that a completion took"),
}  # fmt: skip

Numbers = NDArray[np.float64]


def run_completion(bench: SceneBench) -> None:
    """Complete every view in every row, but those that the journal has."""
    rows = [row for row in bench.rows if any(missing_seeds(bench, row, view) for view in bench.views)]
    for row in rows:
        row.prepare(bench.views)
    with progress() as bar:
        task = add_task(bar, "completing", len(rows) * len(bench.views), "images")
        for row in rows:
            bar.update(task, note=row.name)
            for place, view in enumerate(bench.views):
                if seeds := missing_seeds(bench, row, view):
                    keep_samples(bench, row, view, sample(row, view, place, seeds))
                bar.advance(task)


def missing_seeds(bench: SceneBench, row: Completion, view: View) -> range:
    """Return the seeds of a row that the journal lacks for a view; a row that is not random has a single one."""
    kept = 0
    if bench.journal.has(row.name, view.name):
        kept = len(bench.journal.samples(row.name, view.name)["classes"])
    return range(kept, bench.plan.seeds if row.random else 1)


def keep_samples(bench: SceneBench, row: Completion, view: View, added: dict[str, Tensor]) -> None:
    """Keep samples behind those that the journal has of a row and view."""
    if bench.journal.has(row.name, view.name):
        kept = bench.journal.samples(row.name, view.name)
        added = {name: torch.cat([kept[name], tensor]) for name, tensor in added.items()}
    bench.journal.write_samples(row.name, view.name, added)


def kept_samples(bench: SceneBench, row: Completion, view: View) -> dict[str, Tensor]:
    """Return what ``sample`` gave of a row and view, for as many seeds as are measured."""
    samples = bench.journal.samples(row.name, view.name)
    return {name: tensor[: bench.plan.seeds] for name, tensor in samples.items()}


def sample(row: Completion, view: View, place: int, seeds: Sequence[int]) -> dict[str, Tensor]:
    """Return the classes of a view's region, one draw for each seed, with the seconds of each."""
    classes, known, seconds = [], [], []
    for seed in seeds:
        begun = time.perf_counter()
        done = row.complete(view, place, seed)
        seconds.append(time.perf_counter() - begun)
        classes.append(done.classes)
        known.append(done.known)
    return {"classes": torch.stack(classes), "known": torch.stack(known), "seconds": torch.tensor(seconds)}


def completion_json(bench: SceneBench) -> dict[str, Any]:
    """Return the figures of all rows as JSON values."""
    draws = Draws.of_scenes(view.scene for view in bench.views)
    counts = {row.name: row_counts(bench, row) for row in bench.rows}
    present = [n for n in things(len(bench.palette)) if counts["truth"][..., n, 2].sum() > 0]
    figures = {row.name: row_figures(bench, row, counts[row.name], present, draws) for row in bench.rows}
    layouts = training_layouts(bench.houses, bench.views[0].region)
    return {
        "columns": {name: column.definition for name, column in COLUMNS.items()},
        "unseen": UNSEEN,
        "images": len(bench.views),
        "cells": int(sum(int(view.unseen.sum()) for view in bench.views)),
        "classes": [bench.palette[n] for n in present],
        "rows": {
            row.name: {
                "definition": row.definition,
                "seeds": len(counts[row.name]),
                "figures": figures_json(row.name, figures) | layout_figures(bench, row, layouts),
                "class_iou": {
                    bench.palette[n]: iou_figure(counts[row.name], [n], draws).to_json() for n in (0, 2, *present)
                },
            }
            for row in bench.rows
        },
    }


def row_counts(bench: SceneBench, row: Completion) -> NDArray[np.int64]:
    """Return ``[seed, view, class + 1, 3]`` as of ``class_counts``; what a row leaves unknown counts as free."""
    counts = []
    for view in bench.views:
        samples = kept_samples(bench, row, view)
        said = torch.where(samples["known"], samples["classes"], 0)
        truth, mask = view.truth.classes, view.unseen
        counts.append([class_counts(classes, truth, mask, len(bench.palette)) for classes in said])
    return np.stack(counts, 1)


def row_figures(
    bench: SceneBench, row: Completion, counts: NDArray[np.int64], present: Sequence[int], draws: Draws
) -> dict[str, Figure]:
    """Return the figures of a row that have an interval."""
    samples = {view.name: kept_samples(bench, row, view) for view in bench.views}
    doors, borders = connectedness(bench, samples)
    alike = [disagreement(samples[view.name]["classes"], view.unseen) for view in bench.views]
    different = [distinct(samples[view.name]["classes"], view.unseen) for view in bench.views]
    seconds = torch.stack([samples[view.name]["seconds"] for view in bench.views], 1).double().numpy()
    return {
        "miou": iou_figure(counts, present, draws),
        "structure": iou_figure(counts, [n for n in present if bench.palette[n] in STRUCTURE], draws),
        "iou": iou_figure(counts, [-1], draws),
        "free_iou": iou_figure(counts, [0], draws),
        "outside_iou": iou_figure(counts, [2], draws),
        "doors": mean_figure(doors[None, ..., 0], draws),
        "leading": share_figure(doors[..., 2], doors[..., 0], draws),
        "passable": share_figure(doors[..., 1], doors[..., 0], draws),
        "open": share_figure(borders[..., 0], borders.sum(-1), draws),
        "disagreement": mean_figure(np.array(alike)[None, None], draws),
        "distinct": mean_figure(np.array(different, np.float64)[None, None], draws),
        "seconds": mean_figure(seconds[None], draws),
    }


def connectedness(bench: SceneBench, samples: Mapping[str, Mapping[str, Tensor]]) -> tuple[Numbers, Numbers]:
    """Return ``[seed, view, 3]`` doors: all, passable, leading; and ``[seed, view, 2]`` faces: open, closed."""
    doors, borders = [], []
    for view in bench.views:
        body, known = bench.body(view), view.known.known
        parts = samples[view.name]
        grids = [sampled(view, *sample) for sample in zip(parts["classes"], parts["known"], strict=True)]
        counted = [count_doors(grid, known, body) for grid in grids]
        faces = [count_borders(grid, known) for grid in grids]
        doors.append([[count.all, count.passable, count.leading] for count in counted])
        borders.append([[face.open, face.closed] for face in faces])
    return np.array(doors, np.float64).swapaxes(0, 1), np.array(borders, np.float64).swapaxes(0, 1)


def figures_json(name: str, figures: Mapping[str, Mapping[str, Figure]]) -> dict[str, Any]:
    """Return the figures of a row with the differences of the model to it, as JSON values."""
    compared = [other for other in figures if name == "model" and other not in (name, *CEILINGS)]
    return {
        column: figure.to_json()
        | {"differences": {other: difference(figure, figures[other][column]) for other in compared}}
        for column, figure in figures[name].items()
    }


def training_layouts(houses: Sequence[House], region: Region) -> Tensor | None:
    """Return the plans around one camera of each training house; ``None`` without houses."""
    plans = []
    for house in houses:
        radius = (region.shape[0] // 2) * house.cells.form.size
        around = Region.around(house.cells, house.poses[len(house.poses) // 2], radius)
        around = Region((*around.corner[:2], region.corner[2]), region.shape, around.quarter)
        plans.append(plan_features(true_region(house.cells, around).classes, around, house.cells.form))
    return torch.stack(plans) if plans else None


def layout_figures(bench: SceneBench, row: Completion, layouts: Tensor | None) -> dict[str, Any]:
    """Return precision, recall and coverage of a row's layouts, means over seeds; none without training houses."""
    if layouts is None:
        return {}
    seeds: list[list[Tensor]] = []
    for view in bench.views:
        for seed, classes in enumerate(kept_samples(bench, row, view)["classes"]):
            seeds += [[]] if len(seeds) <= seed else []
            seeds[seed].append(plan_features(classes, view.region, view.truth.form))
    pairs = np.array([precision_recall(torch.stack(plans), layouts) for plans in seeds])
    means = dict(zip(("precision", "recall", "coverage"), pairs.mean(0), strict=True))
    return {name: {"mean": number(float(value)), "low": None, "high": None} for name, value in means.items()}
