"""``persist edit``: change a scene or a map by hand, and show what became of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from persist_cli.api.cell_things import Thing, find_things
from persist_cli.api.cells import CellGrid
from persist_cli.api.memory import Memory
from persist_cli.api.scene import Scene
from persist_cli.api.scene_edits import Edit, EditOutcome
from persist_cli.editing.locality import edit_locality, edited_pixels
from persist_cli.editing.notation import WrittenEdit, edits_json, make_edits, write_edits
from persist_cli.editing.views import (
    Imagination,
    ViewPair,
    cells_before_and_after,
    imagined_before_and_after,
    view_of_data,
    view_of_paths,
    write_views,
)
from persist_cli.errors import DataError, PersistError
from persist_cli.io.files import check_folder, remove_leftovers, write_json
from persist_cli.memorize.memory_file import load_memory, load_paths
from persist_cli.output.console import busy, print_json, print_table, say
from persist_cli.output.map import draw_before_and_after

AROUND = 2  # pixels at the border of what is edited that may change too

FILLED = {  # by ``EditOutcome.filled_by``
    "model": "a model says what they hold",
    "surroundings": "their surroundings say what they hold",
    "both": "a model or their surroundings say what they hold",
}


@dataclass(frozen=True, kw_only=True)
class EditPlan:
    """The options of ``persist edit``; see its help.

    Args:
        memory: the memory file.
        written: the edits in the order of the command line.
        overwrite: whether what is put somewhere may take the place of something.
        seed: of what is imagined where something was taken away.
        camera: frame of data from which the edit is looked at; ``None`` for one on the memory's paths.
        imagination: the world model that imagines the view; ``None`` for none.
    """

    memory: Path
    written: tuple[WrittenEdit, ...]
    overwrite: bool = False
    seed: int = 0
    camera: str | None = None
    imagination: Imagination | None = None


def run_edit(plan: EditPlan, out: Path, save_edits: Path | None, as_json: bool) -> None:
    """Edit a memory file into another, and write a report, its maps and views before and after.

    Args:
        plan: the edits and the view.
        out: memory file to write; beside it are written the report ``.json``, the maps ``.png`` and the views
            ``-views.png``.
        save_edits: JSON file that gets the edits, if any.
        as_json: whether JSON is printed instead of text.

    Raises:
        DataError: when an edit cannot be done, or a file that is written would take the place of another one of this
            command; then nothing is written.
    """
    _check_plan(plan, out)
    _check_files(plan, out, save_edits)
    with busy("loading the memory"):
        memory, paths = load_memory(plan.memory), load_paths(plan.memory)
    edits = make_edits(plan.written, boxes_by_name(memory), plan.overwrite)
    if not edits:
        raise DataError("nothing to edit; for example --remove table#1 or --paint 0,0,0:1,1,1 red, see --help")
    edited, outcome = edit_copy(memory, edits, plan)
    pairs, view = views_of(plan, memory, edited, paths)
    report = describe(plan, edits, memory, outcome) | {"view": view, "pictures": _measured(pairs, memory, edited)}
    files = write_outputs(out, (memory, edited), paths, pairs, report)
    if save_edits is not None:
        write_edits(save_edits, edits)
        files["edits_file"] = str(save_edits)
    if as_json:
        print_json(report | files)
    else:
        say(summary(report, files, plan.camera is not None))


def _check_plan(plan: EditPlan, out: Path) -> None:
    check_folder(out.parent)
    if out.is_dir() or out.suffix in (".png", ".json"):
        raise DataError(f"{out}: name a memory file to write, as in edited.safetensors")
    if plan.imagination is not None and plan.camera is None:
        raise DataError("--checkpoint imagines a view that begins at a true frame; add --camera DATA#trajectory:frame")


def files_beside(out: Path) -> dict[str, Path]:
    """Return the files that stand beside an edited memory, by what they are."""
    return {
        "map": out.with_suffix(".png"),
        "report": out.with_suffix(".json"),
        "views": out.with_name(f"{out.stem}-views.png"),
    }


def _check_files(plan: EditPlan, out: Path, save_edits: Path | None) -> None:
    """Raise ``DataError`` when a file that is written would take the place of what is read or written too."""
    others = {Path(edit.values[0]): "--edits" for edit in plan.written if edit.option == "edits"}
    others |= {plan.memory: "the memory"} | ({} if save_edits is None else {save_edits: "--save-edits"})
    for what, file in files_beside(out).items():
        for other, role in others.items():
            if file.resolve() == other.resolve():
                raise DataError(f"{file}: it is {role}, and the {what} of --out {out} would replace it; rename one")
    if save_edits is not None and save_edits.resolve() in (out.resolve(), plan.memory.resolve()):
        raise DataError(f"{save_edits}: it is the memory, and --save-edits would replace it; name another JSON file")


def boxes_by_name(memory: Memory) -> Mapping[str, Any] | None:
    """Return the boxes of a scene's things by name; ``None`` for a memory whose things have no classes."""
    return {thing.name: thing.box for thing in find_things(memory.cells)} if isinstance(memory, Scene) else None


def edit_copy(memory: Memory, edits: list[Edit], plan: EditPlan) -> tuple[Memory, EditOutcome]:
    """Return an edited copy of a memory and what became of the edits.

    Raises:
        PersistError: when an edit cannot be done; one line that names the file and the edit.
    """
    edited = memory.copy()
    try:
        with busy("editing"):
            return edited, edited.edit(edits, plan.seed)
    except PersistError as error:
        raise type(error)(f"{plan.memory}: {error}") from error


def views_of(
    plan: EditPlan, memory: Memory, edited: Memory, paths: Mapping[str, Float[Tensor, "frame 4 4"]]
) -> tuple[list[ViewPair], str | None]:
    """Return pictures before and after, and where they are taken; none where no camera is known."""
    view = None if plan.camera is None else view_of_data(plan.camera, memory.reference)
    pairs = []
    if (grids := grids_of(memory, edited)) is not None:
        view = view or view_of_paths(paths, *grids)
        pairs += [] if view is None else [cells_before_and_after(*grids, view)]
    if plan.imagination is not None and plan.camera is not None:
        pairs.append(imagined_before_and_after(plan.imagination, plan.camera, plan.memory, edited))
    return pairs, None if view is None else view.name


def grids_of(memory: Memory, edited: Memory) -> tuple[CellGrid, CellGrid] | None:
    """Return the cells of a scene before and after, in one box; ``None`` for a memory of another kind."""
    if not isinstance(memory, Scene) or not isinstance(edited, Scene):
        return None
    before, after = memory.cells, edited.cells
    return before, after.box(before.corner, before.shape)


def _measured(pairs: list[ViewPair], memory: Memory, edited: Memory) -> dict[str, Any]:
    """Return how much the pictures of each kind change where the edit is seen, and elsewhere."""
    grids = grids_of(memory, edited)
    if grids is None:
        return {}
    return {
        pair.title: dataclasses.asdict(
            edit_locality(pair.before, pair.after, edited_pixels(*grids, pair.cameras, AROUND))
        )
        for pair in pairs
    }


def describe(plan: EditPlan, edits: list[Edit], memory: Memory, outcome: EditOutcome) -> dict[str, Any]:
    """Return JSON values that suffice to repeat the edits, with what became of them."""
    return {
        "memory": str(plan.memory),
        "kind": memory.name,
        "scene": memory.reference.name,
        "seed": plan.seed,
        "edits": edits_json(edits),
        **dataclasses.asdict(outcome),
    }


def write_outputs(
    out: Path,
    memories: tuple[Memory, Memory],
    paths: Mapping[str, Float[Tensor, "frame 4 4"]],
    pairs: list[ViewPair],
    report: Mapping[str, Any],
) -> dict[str, str]:
    """Write the edited memory with its maps, views and report, and return the files by what they are."""
    before, after = memories
    files = {"file": out} | files_beside(out)
    views = files.pop("views")
    for path in (*files.values(), views):
        remove_leftovers(path.parent, path.name)
    with busy("writing the memory and its pictures"):
        after.save(out, paths)
        draw_before_and_after(before.points(), after.points(), after.reference.world_up, paths, files["map"])
        views.unlink(missing_ok=True)
        if pairs:
            files["views"] = views
            write_views(views, pairs)
        names = {name: str(path) for name, path in files.items()}
        write_json(files["report"], dict(report) | names)
    return names


def summary(report: Mapping[str, Any], files: Mapping[str, str], camera_named: bool) -> str:
    """Return what became of the edits, for people."""
    uncovered, count = report["uncovered"], len(report["edits"])
    lines = [f"{count} edit{'s' * (count > 1)} changed {report['changed']:,} cells of {report['scene']}"]
    if uncovered:
        lines.append(f"{uncovered:,} of these were never seen before; {FILLED[report['filled_by']]}")
    lines += [f"{title} from {report['view']}: {_change(change)}" for title, change in report["pictures"].items()]
    if "views" not in files:
        camera = "" if camera_named else "--camera DATA#trajectory:frame says from where, and "
        lines.append(f"no view is drawn; {camera}--checkpoint names the model that draws it")
    return "\n".join([*lines, *(f"{name.replace('_', ' ')}: {path}" for name, path in files.items())])


def run_list(path: Path, as_json: bool) -> None:
    """Print the things of a scene with their boxes.

    Raises:
        DataError: when the memory is no scene.
    """
    memory = load_memory(path)
    if not isinstance(memory, Scene):
        raise DataError(
            f"{path}: a memory of kind {memory.name!r} knows no classes, so it has no things to list; its map shows "
            "where they are, and edits take boxes x,y,z:x,y,z"
        )
    things = find_things(memory.cells)
    if as_json:
        print_json([thing_json(thing) for thing in things])
        return
    rows = [
        [thing.name, *(_point(point) for point in (thing.box.low, thing.box.high, thing.middle)), _color(thing.color)]
        for thing in things
    ]
    print_table(f"things of {memory.reference.name}", ["thing", "from", "to", "middle", "colour"], rows)
    if not things:
        say("no thing is known there, apart from floor, walls and ceiling; edits take boxes x,y,z:x,y,z in metres")


def thing_json(thing: Thing) -> dict[str, Any]:
    """Return a thing as values of JSON."""
    box = {"low": thing.box.low, "high": thing.box.high}
    color = _color(thing.color)
    return {
        "name": thing.name,
        "class": thing.kind,
        "cells": len(thing.cells),
        **box,
        "middle": thing.middle,
        "color": color,
    }


def _point(point: tuple[float, float, float]) -> str:
    return ",".join(f"{value:g}" for value in point)


def _color(color: tuple[int, int, int]) -> str:
    return "#" + "".join(f"{shade:02x}" for shade in color)


def _change(change: Mapping[str, float]) -> str:
    """Return in words how a picture changed; nothing looks at an edit that is out of view or hidden."""
    if not change["share"]:
        return "no pixel looks at the edit; --camera DATA#trajectory:frame names another view"
    others = f", others by {change['outside']:.3g}" if change["share"] < 1 else ""
    return f"pixels that look at the edit change by {change['inside']:.3g} of 255 on average{others}"
