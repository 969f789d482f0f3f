"""``persist inspect``: what a data set holds, and whether its cameras, depth, poses and actions agree."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import typer

from persist_cli.data.check.convention import (
    MOST_TRIED,
    OK,
    SUSPICIOUS,
    ConventionCheck,
    check_convention,
    hypotheses,
)
from persist_cli.data.check.motions import wrong_motions
from persist_cli.data.check.others import describe_other
from persist_cli.data.check.reprojection import choose_pairs
from persist_cli.data.importers.gravity import Direction, up_text
from persist_cli.data.reference import Reference, parse_reference
from persist_cli.data.store import TrajectoryFile
from persist_cli.output.console import add_task, print_json, print_table, progress, say, warn


@dataclass(frozen=True)
class TrajectoryFigures:
    """Figures of one trajectory, or of some of its frames.

    Args:
        name: name of the trajectory.
        scene: name of its scene.
        frames: number of frames.
        size: image height and width in pixels.
        field_of_view: degrees from the left to the right border.
        metres: length of the path.
        turned: degrees, all turns added.
        seconds: from the first to the last frame; 0 where frames have no times.
        actions: how often each is taken.
        unknown_actions: those that are taken, but are not in the trajectory's vocabulary.
        cells: whether it holds the cells of its scene.
        world_up: unit vector that points up in the world.
        world_up_is: where that comes from, as far as the source says.
    """

    name: str
    scene: str
    frames: int
    size: tuple[int, int]
    field_of_view: float
    metres: float
    turned: float
    seconds: float
    actions: dict[str, int]
    unknown_actions: list[str]
    cells: bool = False
    world_up: Direction = (0.0, 1.0, 0.0)
    world_up_is: str = ""


def run_inspect(data: str, pairs: int, json: bool) -> None:
    """Print figures and the convention check of ``data``; exit code 1 when it looks wrong.

    Args:
        data: a reference; see ``parse_reference``.
        pairs: largest number of frame pairs to reproject.
        json: print JSON instead of tables.
    """
    other = describe_other(Path(data))
    if other is not None:
        _print_other(data, other, json)
        return
    reference = parse_reference(data)
    files = reference.trajectories()
    figures, check = _inspect(files, reference, pairs)
    actions, motions = action_effects(files), wrong_motions(files, reference.frames)
    if json:
        trajectories = [asdict(one) for one in figures]
        values = {"data": data, "actions": actions, "wrong_motions": motions, "trajectories": trajectories}
        print_json(values | {"check": asdict(check)})
    else:
        print_table(data, ("holds", ""), figures_table(figures, actions))
        print_table(f"convention check, {check.pairs} frame pairs", ("reprojected", ""), check_table(check))
        say(verdict_line(check))
    broken = [one for one in figures if one.unknown_actions]
    for one in broken:
        warn(unknown_actions_line(one))
    for line in motions:
        warn(f"wrong: {line}")
    if check.verdict == SUSPICIOUS or broken or motions:
        raise typer.Exit(1)


def action_effects(files: Sequence[TrajectoryFile]) -> dict[str, str]:
    """What each action of the data set does; where trajectories differ, what it does in each of them."""
    effects: dict[str, list[str]] = {}
    for file in files:
        for action in file.info.vocabulary.actions:
            effects.setdefault(action.name, []).append(action.effect)
    return {name: _distinct(texts) for name, texts in effects.items()}


def unknown_actions_line(figures: TrajectoryFigures) -> str:
    """One line about actions of frames that the trajectory's own vocabulary does not have."""
    names = ", ".join(figures.unknown_actions)
    return (
        f"wrong: frames of {figures.name} take {names}, which its vocabulary does not have; rollouts along it and "
        "training on it would fail: mend the importer or simulator and write it again"
    )


def trajectory_figures(file: TrajectoryFile, frames: slice | None = None) -> TrajectoryFigures:
    """Figures read from poses, times and actions alone; no image is decoded."""
    numbers = file.frame_numbers(frames or slice(None))
    info, poses, times = file.info, file.poses()[numbers], file.timestamps()[numbers]
    names = file.actions()
    taken = dict(Counter(action for number in numbers if (action := names[number]) is not None))
    steps = (poses[1:, :3, 3] - poses[:-1, :3, 3]).norm(dim=-1)
    between = poses[:-1, :3, :3].transpose(1, 2) @ poses[1:, :3, :3]
    cosines = ((between.diagonal(dim1=1, dim2=2).sum(-1) - 1) / 2).clamp(-1, 1)
    left, right = info.intrinsics[0, 2], info.width - info.intrinsics[0, 2]
    focal = float(info.intrinsics[0, 0])
    return TrajectoryFigures(
        name=file.name,
        scene=info.scene,
        frames=len(poses),
        size=(info.height, info.width),
        field_of_view=math.degrees(math.atan(left / focal) + math.atan(right / focal)),
        metres=float(steps.sum()),
        turned=math.degrees(float(cosines.acos().sum())),
        seconds=float(times[-1] - times[0]),
        actions=taken,
        unknown_actions=[name for name in taken if name not in info.vocabulary.names],
        cells=file.has_cells,
        world_up=info.world_up,
        world_up_is=str(info.source.get("world_up", "")),
    )


def figures_table(figures: Sequence[TrajectoryFigures], effects: Mapping[str, str]) -> list[tuple[str, str]]:
    """Rows of name and value that sum up all trajectories, with a row for each action that frames could take.

    Args:
        figures: figures of each trajectory.
        effects: what each action does, by name.
    """
    taken: Counter[str] = Counter()
    for one in figures:
        taken.update(one.actions)
    known = {name: f": {effect}" for name, effect in effects.items()}
    names = [*known, *(name for name in taken if name not in known)]
    sources = [one.world_up_is for one in figures if one.world_up_is]
    with_cells = sum(one.cells for one in figures)
    return [
        ("trajectories", str(len(figures))),
        ("scenes", str(len({one.scene for one in figures}))),
        ("frames", _total([one.frames for one in figures], str)),
        ("image size", _distinct([f"{one.size[0]}×{one.size[1]}" for one in figures])),
        ("field of view", _distinct([f"{one.field_of_view:.1f}°" for one in figures])),
        ("up axis", _distinct([up_text(one.world_up) for one in figures])),
        *([("up axis is", _distinct(sources))] if sources else []),
        ("metres travelled", _total([one.metres for one in figures], "{:.2f}".format)),
        ("degrees turned", _total([one.turned for one in figures], "{:.0f}".format)),
        ("seconds", _total([one.seconds for one in figures], "{:.1f}".format)),
        *([("trajectories with the cells of their scene", str(with_cells))] if with_cells else []),
        *[(f"action {name}{known.get(name, ': not in the vocabulary')}", str(taken[name])) for name in names],
    ]


def check_table(check: ConventionCheck) -> list[tuple[str, str]]:
    """Rows of name and value; a single row when no pair of frames overlaps."""
    rows: list[tuple[str, str]] = [("pairs that see the same place", str(check.overlapping))]
    if check.median_metres is None:
        return rows
    return [
        *rows,
        ("depth error, median", f"{check.median_metres:.4f} m"),
        ("depth error, 95 % of what is not occluded", _metres(check.p95_metres)),
        ("depth error over depth, median", _percent(check.median_relative)),
        ("occluded", _percent(check.occluded)),
        ("there and back, median", f"{check.median_pixels:.2f} pixels"),
        ("colour error, reprojected", f"{check.color_warped:.1f} of 255"),
        ("colour error, same pixel", f"{check.color_unwarped:.1f} of 255"),
    ]


def verdict_line(check: ConventionCheck) -> str:
    """One line with the verdict, the cause when it is not ok, and the faults that the data cannot show."""
    if check.verdict != OK:
        return f"{check.verdict}: {check.cause}"
    if check.undecided:
        return f"{OK}, but this motion would not show: {', '.join(check.undecided)}"
    return f"{OK}: cameras, depth and poses agree"


def _inspect(
    files: list[TrajectoryFile], reference: Reference, pairs: int
) -> tuple[list[TrajectoryFigures], ConventionCheck]:
    """Figures of every trajectory and the convention check, with a progress bar."""
    with progress() as bar:
        task = add_task(bar, "trajectories", len(files), "trajectories")
        figures = []
        for file in files:
            figures.append(trajectory_figures(file, reference.frames))
            bar.advance(task)
        chosen = choose_pairs(files, reference.frames, pairs)
        task = add_task(bar, "frame pairs", len(chosen), "pairs")
        frames = []
        for pair in chosen:
            frames.append(pair.read())
            bar.advance(task)
        tries = len(hypotheses(frames[0].cameras)) * min(len(frames), MOST_TRIED) if frames else 0
        task = add_task(bar, "reprojections", len(frames) + tries, "reprojections")
        return figures, check_convention(frames, partial(bar.advance, task))


def _print_other(path: str, other: str, json: bool) -> None:
    if json:
        print_json({"path": path, "is": other})
    else:
        say(f"{path} is {other}")


def _total(values: Sequence[float], form: Callable[[Any], str]) -> str:
    """The sum and, of several, the range."""
    if len(values) == 1:
        return form(values[0])
    return f"{form(sum(values))} ({form(min(values))} to {form(max(values))} each)"


def _distinct(values: Sequence[str]) -> str:
    """The three most frequent of the different values, and how many more there are."""
    counted = [value for value, _ in Counter(values).most_common()]
    return ", ".join(counted[:3]) + (f" and {len(counted) - 3} more" if len(counted) > 3 else "")


def _metres(value: float | None) -> str:
    return "none" if value is None else f"{value:.4f} m"


def _percent(value: float | None) -> str:
    return "none" if value is None else f"{100 * value:.2f} %"
