"""``persist inspect``: what a data set holds, and whether its conventions agree."""

from __future__ import annotations

from functools import partial

import typer

from persist_cli.trajectories.convention import MOST_TRIED, OK, SUSPICIOUS, Check, check_convention
from persist_cli.trajectories.figures import TrajectoryFigures, figures_table, trajectory_figures
from persist_cli.trajectories.hypotheses import hypotheses
from persist_cli.trajectories.pairs import choose_pairs
from persist_cli.trajectories.reference import Reference, parse_reference
from persist_cli.trajectories.store import TrajectoryFile
from persist_cli.viewing.console import add_task, print_json, print_table, progress, say


def run_inspect(data: str, pairs: int, json: bool) -> None:
    """Print figures and the convention check of ``data``; exit code 1 when it looks wrong.

    Args:
        data: a reference; see ``parse_reference``.
        pairs: frame pairs to reproject.
    """
    reference = parse_reference(data)
    files = reference.trajectories()
    found, check = _look(files, reference, pairs)
    if json:
        print_json({"data": data, "trajectories": [one.to_json() for one in found], "check": check.to_json()})
    else:
        print_table(data, ("holds", ""), figures_table(found, files[0].info.vocabulary))
        print_table(f"convention check, {check.pairs} frame pairs", ("reprojected", ""), check_table(check))
        say(verdict_line(check))
    if check.verdict == SUSPICIOUS:
        raise typer.Exit(1)


def check_table(check: Check) -> list[tuple[str, str]]:
    """Rows of name and value."""
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


def verdict_line(check: Check) -> str:
    """One line: the verdict, the cause when it is not ok, what the data cannot tell."""
    if check.verdict != OK:
        return f"{check.verdict}: {check.cause}"
    if check.undecided:
        return f"{OK}, but this motion would not show: {', '.join(check.undecided)}"
    return f"{OK}: cameras, depth and poses agree"


def _look(files: list[TrajectoryFile], reference: Reference, pairs: int) -> tuple[list[TrajectoryFigures], Check]:
    """Read everything, with a progress bar."""
    with progress() as bar:
        task = add_task(bar, "trajectories", len(files), "trajectories")
        found = []
        for file in files:
            found.append(trajectory_figures(file, reference.frames))
            bar.advance(task)
        chosen = choose_pairs(files, reference.frames, pairs)
        task = add_task(bar, "frame pairs", len(chosen), "pairs")
        frames = []
        for pair in chosen:
            frames.append(pair.read())
            bar.advance(task)
        tries = len(hypotheses(frames[0].cameras)) * min(len(frames), MOST_TRIED) if frames else 0
        task = add_task(bar, "reprojections", len(frames) + tries, "reprojections")
        return found, check_convention(frames, partial(bar.advance, task))


def _metres(value: float | None) -> str:
    return "none" if value is None else f"{value:.4f} m"


def _percent(value: float | None) -> str:
    return "none" if value is None else f"{100 * value:.2f} %"
