"""What a reader needs to distrust the results: one answer to each question that a careful reviewer asks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from persist_cli.evaluate.report.remarks import (
    contamination_lines,
    counted,
    new_poses_line,
    other_samplings,
    sampling_line,
    training_seed_line,
    unknown_scenes_lines,
)
from persist_cli.evaluate.report.result_file import ClipRecord, EvalResults, RowRecord, TableRecord
from persist_cli.evaluate.report.tables import number_text
from persist_cli.evaluate.statistics import LEAST_UNITS

DIGITS = 12  # characters shown of a hash

SHARP = 0.7  # of the truth's, below which a row is called blurred

SETS = ("fvd", "kd-dinov2")  # metrics that are distances between sets, which cost more

CELLS = {"cells": "cells in the map"}  # what has windows and is no metric

GRAINY = 1.5  # grain over sharpness, above which detail is called noise


@dataclass(frozen=True)
class Answer:
    """The answer to a question about the results.

    Args:
        question: what a reader asks.
        lines: the answer, a sentence each.
        doubt: whether the answer is a reason for doubt.
    """

    question: str
    lines: tuple[str, ...]
    doubt: bool = False


def scrutiny(results: EvalResults) -> list[Answer]:
    """Every question with its answer, as far as the results have it."""
    answers = [
        _data(results), _frames(results), _contamination(results), _trainings(results), _intervals(results),
        _choices(results), _truth_read(results), _sharpness(results), _networks(results), _pictures(results),
    ]  # fmt: skip
    return [answer for answer in answers if answer.lines]


def scrutiny_json(results: EvalResults) -> list[dict[str, Any]]:
    """The same as JSON values."""
    return [asdict(answer) for answer in scrutiny(results)]


def _data(results: EvalResults) -> Answer:
    clips, seeds = results.measured.clips, results.sampling.seeds
    scenes = len({clip.scene for clip in clips})
    splits = Counter(split for data in results.measured.data for split in data.splits.values())
    named = ", ".join(f"{counted(number, 'trajectories')} of the split {split}" for split, number in splits.items())
    lines = [
        f"{counted(len(clips), 'clips')} of {results.measured.protocol.frames} frames in {counted(scenes, 'scenes')}",
        f"{named}" if named else "the data does not say of which split it is",
        f"sampling seeds {', '.join(map(str, seeds))}",
    ]
    return Answer("Which clips?", tuple(lines), not named or any(split == "train" for split in splits))


def _frames(results: EvalResults) -> Answer:
    limits = results.measured.protocol.new_poses
    copies = limits is None or not (limits.metres and limits.degrees)
    return Answer("Could a copy do?", (new_poses_line(results),), copies)


def _contamination(results: EvalResults) -> Answer:
    known, unknown = contamination_lines(results), unknown_scenes_lines(results)
    clean = [] if known or unknown else ["no model was trained on any of these scenes"]
    return Answer("Were the models trained on them?", (*known, *unknown, *clean), bool(known or unknown))


def _trainings(results: EvalResults) -> Answer:
    lines = []
    for name, row in _models(results).items():
        if row.training_seeds:
            seeds = "; ".join(", ".join(map(str, stages)) for stages in row.training_seeds)
            bases = f" on {counted(row.bases, 'bases')}" if row.bases and len(row.training_seeds) > 1 else ""
            lines.append(f"{name}: {counted(len(row.training_seeds), 'trainings')}{bases}, seeds of the stages {seeds}")
    few = training_seed_line(results)
    return Answer("How many trainings?", (*lines, *([few] if few else [])), bool(few))


def _intervals(results: EvalResults) -> Answer:
    unit, resamples = results.statistics.resampled, results.statistics.resamples
    drawn = {"scenes": "whole scenes with all their clips", "clips": "single clips, as if they were independent"}[unit]
    trainings = " and trainings" if any(len(row.training_seeds) > 1 for row in _models(results).values()) else ""
    count = f"{resamples:,} " if resamples else ""
    sets = " and ".join(metric.title for name, metric in results.measured.metrics.items() if name in SETS)
    fewer = results.statistics.set_resamples
    of_sets = f" ({fewer} for {sets})" if fewer and sets else ""
    lines = [
        f"95 % intervals from {count}bootstrap samples{of_sets} that draw {drawn}{trainings}; none below {LEAST_UNITS} "
        f"{unit}"
    ]
    clips = results.measured.clips
    scenes = len({clip.scene for clip in clips})
    if unit == "clips" and scenes < len(clips):
        lines.append(f"these clips are of {counted(scenes, 'scenes')}, so intervals over clips are too narrow")
    if unit == "clips" and (shared := sharing_clips(clips)):
        lines.append(
            f"{shared} of {counted(len(clips), 'clips')} predict frames that others predict, too: for intervals they "
            "are fewer than they seem"
        )
    return Answer("What do the intervals cover?", tuple(lines), len(lines) > 1 or scenes < LEAST_UNITS)


def sharing_clips(clips: Sequence[ClipRecord]) -> int:
    """Number of clips some of whose predicted frames, all but the first, another clip predicts, too."""
    predicted = [
        {(clip.data, clip.trajectory, frame) for frame in range(clip.start + 1, clip.start + clip.frames)}
        for clip in clips
    ]
    times = Counter(frame for frames in predicted for frame in frames)
    return sum(any(times[frame] > 1 for frame in frames) for frames in predicted)


def _choices(results: EvalResults) -> Answer:
    sampled = sampling_line(results)
    if not sampled:
        return Answer("What was chosen, and on which data?", ())
    everyone = "all models" if results.sampling.sampling_of == {} else "models"
    lines = [f"{everyone} were sampled with {sampled}, {results.sampling.chosen or 'of unknown origin'}"]
    lines += other_samplings(results)
    lines += [f"{record.name}: {record.chosen_on}" for record in results.checkpoints if record.chosen_on]
    unknown = [record.name for record in results.checkpoints if not record.chosen_on]
    if unknown:
        lines.append(
            "neither card nor recipe says on which data cells, head and sampling of "
            f"{', '.join(dict.fromkeys(unknown))} were chosen: if on these scenes, the figures flatter"
        )
    return Answer("What was chosen, and on which data?", tuple(lines), bool(unknown))


def _truth_read(results: EvalResults) -> Answer:
    lines = {}
    for name, row in ((name, row) for table in results.tables for name, row in table.rows.items() if row.truth):
        made = "" if row.reads is None else f", made {'with' if row.reads.reads_depth else 'without'} their depth"
        lines[name] = f"{name}: {row.truth}{made}"
    return Answer("Which rows are given truth?", tuple(lines.values()))


def _sharpness(results: EvalResults) -> Answer:
    lines, blurred = [], False
    for table in results.tables:
        where = f"{table.name}, " if len(results.tables) > 1 else ""
        for name in (name for name, row in table.rows.items() if row.kind == "model"):
            psnr, sharp, grain = (_mean(table, name, metric) for metric in ("psnr", "sharpness", "grain"))
            if psnr is None or sharp is None:
                continue
            verdict = "blurred: part of its PSNR may be that of a blurred guess" if sharp < SHARP else ""
            verdict = "its detail is noise" if grain is not None and grain > GRAINY * sharp and grain > 1 else verdict
            blurred |= bool(verdict)
            lines.append(
                f"{where}{name}: PSNR {number_text(psnr, 2)} at sharpness {number_text(sharp, 2)} (truth 1)"
                + f", grain {number_text(grain, 2)}" * (grain is not None)
                + f"; {verdict}" * bool(verdict)
            )
    return Answer(
        "Sharp, or only near on average?", tuple(lines or ["not measured: --metrics psnr,sharpness"]), blurred
    )


def _networks(results: EvalResults) -> Answer:
    lines = [
        f"{metric.title}: {name} ({metric.sources.get(name) or 'source unknown'}), sha256 {digest[:DIGITS]}"
        for metric in results.measured.metrics.values()
        for name, digest in metric.weights.items()
    ]
    return Answer("Which networks judge?", tuple(lines))


def _pictures(results: EvalResults) -> Answer:
    rows = [row for table in results.tables for row in table.rows.values()]
    firsts = dict.fromkeys(name for row in rows for name in [*row.curves][:1])  # only metrics of frames have curves
    titles = " or ".join(results.measured.metrics[name].title for name in firsts)
    picked = f"each row's best, median and worst clip by {titles}, and " if titles else ""
    return Answer("Are the pictures picked?", (f"{picked}the first clips of the list in every row",))


def _models(results: EvalResults) -> dict[str, RowRecord]:
    return {name: row for table in results.tables for name, row in table.rows.items() if row.kind == "model"}


def _mean(table: TableRecord, row: str, column: str) -> float | None:
    cell = table.rows[row].columns.get(column)
    return None if cell is None else cell.mean


def windows_tables(results: EvalResults) -> Sequence[tuple[str, list[str], list[list[str]]]]:
    """Tables of the windows along the rollouts: title, headings, and the texts of each row."""
    tables = []
    for table in results.tables:
        where = f"{table.name}, " if len(results.tables) > 1 else ""
        for metric in dict.fromkeys(name for row in table.rows.values() for name in row.windows):
            rows = {name: row.windows[metric] for name, row in table.rows.items() if metric in row.windows}
            record = results.measured.metrics.get(metric)
            count = max(map(len, rows.values()))
            digits = 0 if record is None else 2
            name = record.title if record else CELLS.get(metric, metric)
            title = f"{where}{name} along the rollout"
            heads = ["row", *_window_heads(results.windows.get(metric, []), count)]
            texts = [[name, *(number_text(value, digits) for value in values)] for name, values in rows.items()]
            tables.append((title, heads, texts))
    return tables


def _window_heads(bounds: Sequence[tuple[int, int]], count: int) -> list[str]:
    """The frames of each window, or its number where the results do not say them."""
    if len(bounds) != count:
        return [f"window {number}" for number in range(1, count + 1)]
    return [f"{first}–{last}" if last > first else str(first) for first, last in bounds]
