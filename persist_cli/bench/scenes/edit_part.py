"""The part "edits" of the benchmark: whether an edit of the cells is seen in the rendered frames, and only there.

A scene holds the true cells of a house. A thing is taken away, painted, put in, moved or copied at random, where the
last frame of a clip sees it and the first one, which is given, does not. The clip is imagined before and after the edit
with the same noise, and before it with other noise, which says how much sampling alone changes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.cell_rays import first_surfaces
from persist_cli.api.cell_things import find_things
from persist_cli.api.cells import FREE, CellGrid
from persist_cli.api.observations import Observations
from persist_cli.api.scene import Scene
from persist_cli.api.scene_edits import Copy, Edit, Insert, Move, Paint, Remove
from persist_cli.bench.figure_text import FigureColumn
from persist_cli.bench.scenes.rendering import RenderedRow, Renderer, RendererLoader, rendered_rows, scene_row
from persist_cli.bench.scenes.scene_bench import EDIT_KINDS, RenderingPlan, SceneBench
from persist_cli.bench.scenes.views import View
from persist_cli.data.reference import parse_reference
from persist_cli.editing.locality import edit_locality, edited_pixels
from persist_cli.errors import DataError
from persist_cli.evaluate.statistics import Draws, mean_figure
from persist_cli.output.console import add_task, progress, warn

PART: Final = "edits"

COLORS: Final = ((220, 30, 30), (30, 180, 30), (40, 60, 220), (230, 210, 30), (210, 40, 200), (30, 200, 210))

LEAST_PIXELS: Final = 0.01  # share of the last frame that must look at the edit

AROUND: Final = 4  # pixels around the edit that are not counted as elsewhere: half of a latent's pixel

TRIES: Final = 40  # of clips and edits for each edit that is wanted

REACH: Final = (1.0, 3.5)  # metres from the camera within which a thing is put

MOVED: Final = (0.75, 1.5)  # metres on the ground by which a thing is moved, or its copy put beside it

OTHER_NOISE: Final = 1_000_000  # what a seed grows by for other noise; no other edit has that seed

SIZE: Final = (0.75, 0.75, 1.0)  # metres of a thing that is put in

COLUMNS: Final = {
    "there": FigureColumn(
        "edit is there", "higher", True,
        "share of edits whose pixels in the rendered frame after it have a mean colour (RGB) that is nearer to that of "
        "the edited cells, drawn by rays, than to that of the cells before",
    ),
    "there_before": FigureColumn("so before", "lower", True, "the same of the frame that was rendered before the edit"),
    "inside": FigureColumn("change inside", "higher", False, "mean absolute difference of edited pixels, 0 to 255"),
    "outside": FigureColumn(
        "change outside", "lower", False, f"that of pixels more than {AROUND} pixels away from the edit, same noise"
    ),
    "noise": FigureColumn("sampling noise", None, False, "that of the same pixels without an edit, other noise"),
    "local": FigureColumn("local", "higher", True, "share of edits that change less outside than other noise does"),
}  # fmt: skip


@dataclass(frozen=True)
class EditTrial:
    """One random edit, with the clip in which it is looked at.

    Args:
        view: the clip's first frame, with the house.
        path: cameras of the clip's other frames.
        before: the scene with the true cells.
        after: the same after the edit.
        kind: of the edit.
    """

    view: View
    path: Cameras
    before: Scene
    after: Scene
    kind: str


def run_edits(bench: SceneBench, plan: RenderingPlan) -> None:
    """Make the edits that the journal lacks, and render them by the first of the adapters that draw scenes."""
    row = scene_row(rendered_rows(plan))
    todo = [number for number in range(bench.plan.edits) if not bench.journal.has(PART, edit_name(row, number))]
    if not todo:
        return
    renderer = RendererLoader(bench, plan, "edits").load(row)
    with progress() as bar:
        task = add_task(bar, "editing scenes", len(todo), "edits")
        for number in todo:
            trial = draw_edit(bench, renderer, number)
            record = {"scene": None} if trial is None else judge_edit(bench, renderer, trial, number)
            bench.journal.write(PART, edit_name(row, number), record)
            bar.advance(task)


def edit_name(row: RenderedRow, number: int) -> str:
    """Return the name of an edit in the journal; edits that another adapter draws have other names."""
    return f"edit {number}, {row.adapter}"


def draw_edit(bench: SceneBench, renderer: Renderer, number: int) -> EditTrial | None:
    """Draw a random edit that the last frame of a clip sees and its first one does not; ``None`` without any."""
    random = np.random.default_rng([bench.plan.seed, number])
    kind = EDIT_KINDS[number % len(EDIT_KINDS)]
    for _ in range(TRIES):
        view, path = draw_clip(bench, random, renderer.backbone.frames_per_clip)
        before = renderer.scene(view)
        edit = draw_change(kind, before.cells, path[-1:], random)
        if edit is None:
            continue
        after = before.copy()
        try:
            after.edit([edit], number)
        except DataError:  # something stands there, or the box is outside: another draw
            continue
        if is_visible(before.cells, after.cells, view.frame.cameras, path):
            return EditTrial(view, path, before, after, kind)
    return None


def draw_clip(bench: SceneBench, random: np.random.Generator, frames: int) -> tuple[View, Cameras]:
    """Return the first frame of a random clip of a measured house, and the cameras of the others."""
    view = bench.views[int(random.integers(len(bench.views)))]
    file = next(file for file in parse_reference(bench.plan.data).trajectories() if file.info.scene == view.scene)
    first = int(random.integers(max(1, len(file) - frames + 1)))
    clip = file.read(slice(first, min(first + frames, len(file)))).observations
    return replace(view, frame=clip[:1], house=file.cells(first)), clip.cameras[1:]


def draw_change(kind: str, cells: CellGrid, camera: Cameras, random: np.random.Generator) -> Edit | None:
    """Return a random edit of a kind that a camera may see; ``None`` when there is nothing to edit."""
    color = COLORS[int(random.integers(len(COLORS)))]
    if kind == "insert":
        return draw_insertion(cells, camera, color, random)
    seen = first_surfaces(cells, camera).cells.unique()
    marked = torch.zeros(cells.classes.numel(), dtype=torch.bool)
    marked[seen[seen >= 0]] = True
    visible = marked.view(cells.shape)
    things = [thing for thing in find_things(cells) if bool(visible[tuple(thing.cells.T)].any())]
    if not things:
        return None
    box = things[int(random.integers(len(things)))].box
    match kind:
        case "remove":
            return Remove(low=box.low, high=box.high)
        case "paint":
            return Paint(low=box.low, high=box.high, color=color)
        case "move":
            return Move(low=box.low, high=box.high, by=draw_shift(cells, random))
        case _:
            return Copy(low=box.low, high=box.high, by=draw_shift(cells, random))


def draw_shift(cells: CellGrid, random: np.random.Generator) -> tuple[float, float, float]:
    """Return a random vector on the ground, in metres of the world."""
    angle, length = random.uniform(-np.pi, np.pi), random.uniform(*MOVED)
    ground = torch.tensor([length * np.cos(angle), length * np.sin(angle), 0.0], dtype=torch.float64)
    x, y, z = (ground @ cells.axes).tolist()
    return x, y, z


def draw_insertion(
    cells: CellGrid, camera: Cameras, color: tuple[int, int, int], random: np.random.Generator
) -> Edit | None:
    """Return a coloured table on free ground before a camera; ``None`` where the palette has none or no ground is."""
    if "table" not in cells.form.palette:
        return None
    away = (cells.centers() - camera.centers[0].double()) @ cells.axes.T
    ahead = (cells.axes @ camera.world_from_camera[0, :3, 2].double())[:2]
    distance = away[..., :2].norm(dim=-1)
    before = (away[..., :2] @ ahead) > 0.8 * distance
    level = max(0, 1 - cells.corner[2])  # the first above the floor
    free = cells.known & (cells.classes == FREE) & before & (distance > REACH[0]) & (distance < REACH[1])
    places = free[..., level].nonzero()
    if not len(places):
        return None
    first, second = places[int(random.integers(len(places)))].tolist()
    up = (cells.corner[2] + level - 0.5) * cells.form.size
    ground = [(first + cells.corner[0]) * cells.form.size, (second + cells.corner[1]) * cells.form.size, up]
    x, y, z = (torch.tensor(ground, dtype=torch.float64) @ cells.axes).tolist()
    return Insert(kind="table", at=(x, y, z), size=SIZE, color=color)


def is_visible(before: CellGrid, after: CellGrid, given: Cameras, path: Cameras) -> bool:
    """Return whether the last camera of a path sees an edit, and the given first one does not."""
    if before.corner != after.corner or before.shape != after.shape:
        before = before.box(after.corner, after.shape)
    hidden = not bool(edited_pixels(before, after, given, AROUND).any())
    return hidden and float(edited_pixels(before, after, path[-1:]).float().mean()) >= LEAST_PIXELS


def judge_edit(bench: SceneBench, renderer: Renderer, trial: EditTrial, number: int) -> dict[str, Any]:
    """Render the last frame before and after an edit, and return its figures as JSON values."""
    cells, edited = trial.before.cells, trial.after.cells
    cells = cells.box(edited.corner, edited.shape)
    last = trial.path[-1:]
    mask = edited_pixels(cells, edited, last)
    wide = edited_pixels(cells, edited, last, AROUND)
    drawn = [first_surfaces(grid, last).colors(grid)[0] for grid in (cells, edited)]
    before = rendered(bench, renderer, trial, trial.before.copy(), number)
    after = rendered(bench, renderer, trial, trial.after, number)
    other = rendered(bench, renderer, trial, trial.before, number + OTHER_NOISE)
    return {
        "scene": trial.view.scene,
        "kind": trial.kind,
        "there": float(shows(after, drawn, mask)),
        "there_before": float(shows(before, drawn, mask)),
        "inside": edit_locality(before, after, mask).inside,
        "outside": edit_locality(before, after, wide).outside,
        "noise": edit_locality(before, other, wide).outside,
    }


def rendered(
    bench: SceneBench, renderer: Renderer, trial: EditTrial, memory: Scene, seed: int
) -> UInt8[Tensor, "1 height width 3"]:
    """Return the last frame of a trial's clip, as it is imagined with a memory."""
    world = renderer.world(memory.placed(renderer.backbone.device), trial.view, seed, False, bench)
    clips: list[Observations] = [seen for [seen] in world.imagine([trial.path], [(None,) * len(trial.path)])]
    return clips[-1].rgb[-1:]


def shows(picture: Tensor, drawn: list[Tensor], mask: Tensor) -> bool:
    """Return whether the mean colour of some pixels is nearer to the second of two drawings than to the first."""
    color, before, after = (image[mask].float().mean(0) for image in (picture, *drawn))
    return bool((color - after).norm() < (color - before).norm())


def edits_json(bench: SceneBench, plan: RenderingPlan) -> dict[str, Any]:
    """Return the figures over all edits and over each kind, as JSON values."""
    row = scene_row(rendered_rows(plan))
    records = [bench.journal.read(PART, edit_name(row, number)) for number in range(bench.plan.edits)]
    found = [record for record in records if record["scene"] is not None]
    if len(found) < len(records):
        warn(f"{len(records) - len(found)} of {len(records)} edits: no place was found that a clip comes to see")
    groups = {"all": found} | {kind: [one for one in found if one["kind"] == kind] for kind in EDIT_KINDS}
    return {
        "columns": {name: column.definition for name, column in COLUMNS.items()},
        "adapter": row.adapter,
        "wanted": len(records),
        "rows": {name: kind_figures(chosen) | {"count": len(chosen)} for name, chosen in groups.items() if chosen},
    }


def kind_figures(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures of some edits, as JSON values."""
    draws = Draws.of_scenes(record["scene"] for record in records)

    def values() -> Iterator[tuple[str, list[float]]]:
        for name in ("there", "there_before", "inside", "outside", "noise"):
            yield name, [float(record[name]) for record in records]
        yield "local", [float(record["outside"] <= record["noise"]) for record in records]

    return {name: mean_figure(np.array(numbers)[None, None], draws).to_json() for name, numbers in values()}
