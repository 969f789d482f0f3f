"""The part "walk" of the benchmark: whether a scene stays a house when an agent walks on in it for a thousand steps.

The agent sees one image and walks off: ahead until the scene does not let it, then it turns to a random side and goes
on. Before each step the scene imagines what the next camera will see. Nothing is rendered. What is new in each window
of 100 steps is counted by class. A scene that collapses imagines ever more of one class, or nothing but walls.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from persist_cli.api.actions import ActionVocabulary
from persist_cli.api.cells import FREE, CellGrid
from persist_cli.bench.figure_text import FigureColumn
from persist_cli.bench.scenes.class_counts import class_counts, mean_iou, things
from persist_cli.bench.scenes.connectedness import may_step
from persist_cli.bench.scenes.scene_bench import SceneBench
from persist_cli.bench.scenes.views import View
from persist_cli.evaluate.statistics import Draws, mean_figure
from persist_cli.output.console import add_task, progress
from persist_cli.policies.simple import gait

PART: Final = "walk"

WINDOW: Final = 100  # steps

TURNS: Final = (2, 9)  # of the agent where it is stopped, the last not included

COLUMNS: Final = {
    "new": FigureColumn("new cells", None, False, f"cells imagined in a window of {WINDOW} steps"),
    "occupied": FigureColumn("occupied", None, True, "share of these that are neither free nor outside"),
    "free": FigureColumn("free", None, True, "share of these that are free"),
    "drift": FigureColumn(
        "class drift", "lower", True,
        "total variation distance between the classes of these and those of the measured houses' own cells: half the "
        "sum of the absolute differences of shares",
    ),
    "miou": FigureColumn("mIoU", "higher", True, "of these, where they lie in the true house's own cells"),
    "blocked": FigureColumn("blocked", None, True, "share of steps ahead that the scene did not allow"),
    "metres": FigureColumn("metres", None, False, "metres walked in the window"),
    "seconds": FigureColumn("s/step", "lower", False, "seconds of a step: imagining, moving and nothing else"),
}  # fmt: skip


class Wanderer:
    """Walks ahead until it is stopped, then turns to a random side.

    Args:
        vocabulary: has a step ahead and turns.
        random: source of sides and angles.
    """

    def __init__(self, vocabulary: ActionVocabulary, random: np.random.Generator) -> None:
        self.ahead, self.turns = gait(vocabulary)
        self.random, self.left = random, 0
        self.side = self.turns[0]

    def next(self, stopped: bool) -> str:
        """Return the next action, after one that was refused or not."""
        if stopped:
            self.side = self.turns[int(self.random.integers(len(self.turns)))]
            self.left = int(self.random.integers(*TURNS))
        if not self.left:
            return self.ahead.name
        self.left -= 1
        return self.side.name


def run_walks(bench: SceneBench) -> None:
    """Walk from some of the views, once for each seed, but where the journal has the walk."""
    units = [(view, seed) for view in walked(bench) for seed in range(bench.plan.seeds)]
    todo = [unit for unit in units if not bench.journal.has(PART, walk_name(*unit))]
    with progress() as bar:
        task = add_task(bar, "walking in scenes", len(todo) * bench.plan.steps, "steps")
        for view, seed in todo:
            windows = []
            for window in walk(bench, view, seed):
                windows.append(window)
                bar.advance(task, window["steps"])
            bench.journal.write(PART, walk_name(view, seed), {"windows": windows})


def walked(bench: SceneBench) -> Sequence[View]:
    """Return the views from which an agent walks, evenly spread over all."""
    count = min(bench.plan.walks, len(bench.views))
    return [bench.views[n] for n in np.linspace(0, len(bench.views) - 1, count).round().astype(int)]


def walk_name(view: View, seed: int) -> str:
    """Return the name of a walk in the journal."""
    return f"{view.name} seed {seed}"


def walk(bench: SceneBench, view: View, seed: int) -> Iterator[dict[str, Any]]:
    """Yield a record of each window of a walk from a view."""
    scene, body = bench.scenes.seeded(seed).after(view), bench.body(view)
    scene.complete(view.region.box(view.truth), seed)
    up = torch.tensor(view.info.world_up, dtype=torch.float64)
    camera, vocabulary = view.frame.cameras, view.info.vocabulary
    wanderer, stopped = Wanderer(vocabulary, np.random.default_rng([seed, 1])), False
    for first in range(0, bench.plan.steps, WINDOW):
        before, begun = scene.cells.copy(), time.perf_counter()
        steps = min(WINDOW, bench.plan.steps - first)
        tried, refused, metres = 0, 0, 0.0
        for _ in range(steps):
            action = vocabulary[wanderer.next(stopped)]
            pose = camera.world_from_camera[0]
            there = camera.at(vocabulary.move(pose, action.name, up)[None])
            scene.foresee([there])
            stopped = bool(action.forward) and not may_step(scene.cells, body, pose[:3, 3], there.centers[0])
            tried, refused = tried + bool(action.forward), refused + stopped
            metres += 0.0 if stopped else abs(action.forward)
            camera = camera if stopped else there
        seconds = time.perf_counter() - begun
        yield {"steps": steps, "tried": tried, "refused": refused, "metres": metres, "seconds": seconds} | new_cells(
            before, scene.cells, view
        )


def new_cells(before: CellGrid, after: CellGrid, view: View) -> dict[str, Any]:
    """Return how many cells of each class are new, and how those in the true house agree with it, as JSON values."""
    new = after.known & ~before.box(after.corner, after.shape).known
    classes = len(after.form.palette)
    counts = torch.bincount(after.classes[new].long(), minlength=classes).tolist()
    truth = view.house.box(after.corner, after.shape)
    agreement = class_counts(after.classes, truth.classes, new & truth.known, classes)
    return {"new": counts, "agreement": agreement.tolist()}


def walk_json(bench: SceneBench) -> dict[str, Any]:
    """Return the figures of each window over all walks, as JSON values."""
    views = walked(bench)
    draws = Draws.of_scenes(view.scene for view in views)
    truth = house_shares(views, len(bench.palette))
    rows = {}
    records = [
        [bench.journal.read(PART, walk_name(view, seed))["windows"] for view in views]
        for seed in range(bench.plan.seeds)
    ]
    for number in range(len(records[0][0])):
        values = [[window_values(walk[number], truth) for walk in walks] for walks in records]
        last = number * WINDOW + records[0][0][number]["steps"]
        rows[f"{number * WINDOW + 1}-{last}"] = {
            name: mean_figure(np.array([[[value[name] for value in walks] for walks in values]]), draws).to_json()
            for name in COLUMNS
        }
    return {
        "columns": {name: column.definition for name, column in COLUMNS.items()},
        "views": [view.name for view in views],
        "true_shares": dict(zip(bench.palette, truth.tolist(), strict=True)),
        "windows": rows,
    }


def house_shares(views: Sequence[View], classes: int) -> NDArray[np.float64]:
    """Return the share of each class among all cells of the measured houses."""
    counts = sum(torch.bincount(view.house.classes[view.house.known].long(), minlength=classes) for view in views)
    shares: NDArray[np.float64] = np.asarray(counts, np.float64) / max(1, int(np.sum(np.asarray(counts))))
    return shares


def window_values(window: Mapping[str, Any], truth: NDArray[np.float64]) -> dict[str, float]:
    """Return the figures of one window of one walk; NaN where nothing was new."""
    new = np.array(window["new"], np.float64)
    total = new.sum()
    shares = new / total if total else np.full_like(new, np.nan)
    agreement = np.array(window["agreement"], np.int64)
    present = [n for n in things(len(new)) if agreement[n, 2] > 0]
    return {
        "new": float(total),
        "occupied": float(1 - shares[FREE] - shares[2]),
        "free": float(shares[FREE]),
        "drift": float(np.abs(shares - truth).sum() / 2),
        "miou": float(mean_iou(agreement, present)) if present else float("nan"),
        "blocked": window["refused"] / window["tried"] if window["tried"] else float("nan"),
        "metres": window["metres"],
        "seconds": window["seconds"] / window["steps"],
    }
