"""Remarks below a table: what it leaves out and why, what is too little for an interval, what the models knew."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from persist_cli.api.checkpoint import run_folder
from persist_cli.api.training_scenes import name_ranges
from persist_cli.evaluate.report.result_file import CheckpointRecord, EvalResults, SamplingSettings
from persist_cli.evaluate.report.tables import MARK, CompactTable, TableView, compact_tables
from persist_cli.evaluate.statistics import LEAST_MODELS, LEAST_UNITS

MOST_SCENES = 3  # names or ranges of scenes in a warning

ALL_COUNT = ("kd-dinov2", "src", "src-patch", "src-away", "psnr-own", "lpips-own", "rot-error", "trans-error")
"""Metrics that do not compare a frame with the true one of its pose, so that they leave out none."""

FETCH = re.compile(r"weights \S.* are not here: (?P<command>persist weights fetch) (?P<name>\S+)(?P<options>.*)")


def figure_legend(results: EvalResults, table: CompactTable) -> str:
    """A sentence that says what stands in a cell of the figures and of the differences."""
    parts = [seed_legend(results)]
    if table.has_intervals:
        parts.append(f"[95 % interval, bootstrap over {drawn_units(results)}]")
    if table.has_differences:
        parts.append(difference_legend(results, table.has_intervals))
    return "; ".join(parts)


def seed_legend(results: EvalResults) -> str:
    """Say what a figure is the mean of."""
    seeds = len(results.sampling.seeds)
    sampling = f"mean ± standard deviation over {seeds} sampling seeds" if seeds > 1 else "one sampling seed"
    if any(len(row.training_seeds) > 1 for table in results.tables for row in table.rows.values()):
        return f"mean ± standard deviation over training seeds where a row has several; else {sampling}"
    return sampling if seeds > 1 else f"mean over clips, {sampling}"


def sampling_line(results: EvalResults) -> str:
    """How the models' clips were sampled in this protocol; empty when the results do not say.

    Results of earlier versions do not say here whether some rows were sampled otherwise, so the line leaves it open.
    """
    sampling = results.sampling
    if not sampling.steps:
        return ""
    return f"{_sampled(sampling)}{'' if sampling.sampling_of == {} else ' unless the row says otherwise'}"


def other_samplings(results: EvalResults) -> list[str]:
    """Each memory whose rows were sampled in another way than ``sampling_line`` says, and in which."""
    own = results.sampling.sampling_of or {}
    return [f"{memory} was sampled with {_sampled(sampling)}" for memory, sampling in own.items()]


def _sampled(sampling: SamplingSettings) -> str:
    if not sampling.steps:
        return "unknown steps"
    guidance = "" if sampling.memory_guidance in (None, 1.0) else f", guidance over memory {sampling.memory_guidance:g}"
    noise = f", declared context noise {sampling.context_noise:g}" if sampling.context_noise else ""
    away = f", autoguidance {sampling.autoguidance:g}" if sampling.autoguidance != 1 else ""
    return f"{counted(sampling.steps, 'steps')} of {sampling.sampler}{guidance}{noise}{away}"


def training_seed_line(results: EvalResults) -> str:
    """Say which models have fewer training seeds than a claim needs; empty when there are none, or nothing is known.

    An interval over scenes does not hold what another training of the same recipe would change.
    """
    rows = {name: len(row.training_seeds) for table in results.tables for name, row in table.rows.items()
            if row.kind == "model" and row.training_seeds}  # fmt: skip
    few = {name: count for name, count in rows.items() if count < LEAST_MODELS}
    if not few:
        return ""
    counts = " and ".join("one training seed" if count == 1 else f"{count} training seeds" for count in {*few.values()})
    return (
        f"{counts} ({', '.join(few)}): a difference between two such models may be that of two trainings; "
        f"give {LEAST_MODELS} of each with --training-seeds"
    )


def difference_legend(results: EvalResults, intervals: bool) -> str:
    """Say what a difference is and, where there are intervals, what the mark behind it means."""
    mark = f"; {MARK} its 95 % interval (bootstrap over {drawn_units(results)}) leaves zero out" if intervals else ""
    return f"Δ: paired difference to {results.first_row}{mark}"


def drawn_units(results: EvalResults) -> str:
    """What every bootstrap sample draws anew."""
    return results.statistics.resampled


def too_few_lines(view: TableView) -> list[str]:
    """A line that says why a table has no intervals, or which of its columns have none."""
    if view.units < LEAST_UNITS:
        return [too_few(view.units, view.unit)]
    few = [column for column in view.columns if 0 < column.fewest < LEAST_UNITS]
    return [f"{column.heading}: defined for {too_few(column.fewest, view.unit)}" for column in few]


def too_few(units: int, unit: str) -> str:
    """Say that so many scenes, or clips, are too few for an interval."""
    return f"{counted(units, unit)}: too few for an interval; give at least {LEAST_UNITS}"


def counted(number: int, plural: str) -> str:
    """A number with its noun, as in ``1 clip`` and ``2 clips``."""
    singular = f"{plural.removesuffix('ies')}y" if plural.endswith("ies") else plural.removesuffix("s")
    return f"{number} {plural if number != 1 else singular}"


def left_out_line(left_out: dict[str, list[str]], commands: bool = True) -> str:
    """One line that names the columns without a figure and the reasons, empty when there are none.

    Args:
        left_out: names by reason, as ``CompactTable`` has them.
        commands: whether the commands that help are named too.
    """
    groups: dict[str, list[str]] = {}
    for reason, names in _together(left_out).items() if commands else left_out.items():
        groups.setdefault(reason if commands else without_command(reason), []).extend(names)
    parts = [f"{', '.join(dict.fromkeys(names))} ({reason})" for reason, names in groups.items()]
    return f"left out: {'; '.join(parts)}" if parts else ""


def without_command(reason: str) -> str:
    """A reason without the command that would help."""
    return "; ".join(part.partition(": persist ")[0] for part in reason.split("; "))


def new_poses_line(results: EvalResults) -> str:
    """One line that says how many predicted frames count, and which; results of earlier versions counted all."""
    protocol = results.measured.protocol
    if protocol.new_poses is None or not (protocol.new_poses.metres and protocol.new_poses.degrees):
        return "every predicted frame counts, also where the memory holds a frame of the same pose"
    limits = f"{protocol.new_poses.metres:g} m and {protocol.new_poses.degrees:g}°"
    whole, all_frames = measured_titles(results, ("fvd",)), measured_titles(results, ALL_COUNT)
    return (
        f"{protocol.counted_frames} of {protocol.predicted_frames} predicted frames count: those to which no frame in "
        f"memory is nearer than {limits}"
        + f"; {', '.join(whole)}: whole videos" * bool(whole)
        + f"; {', '.join(all_frames)}: the others, too" * bool(all_frames)
    )


def measured_titles(results: EvalResults, names: Sequence[str]) -> list[str]:
    """Titles of those of some metrics of which a row has a figure."""
    rows = [row for table in results.tables for row in table.rows.values()]
    found = {key for row in rows for key, cell in row.columns.items() if cell.mean is not None}
    measured = {column.metric for key, column in results.columns.items() if key in found}
    return [metric.title for name, metric in results.measured.metrics.items() if name in names and name in measured]


def contamination_lines(results: EvalResults) -> list[str]:
    """A warning for each checkpoint that was trained on scenes of the evaluated clips."""
    total = len({clip.scene for clip in results.measured.clips})
    return [
        contamination(
            record.path or record.name, record.training_scenes.evaluated, total, results.training_scenes_allowed
        )
        for record in results.checkpoints
        if record.training_scenes and record.training_scenes.evaluated
    ]


def contamination(path: str, scenes: Sequence[str], total: int, allowed: bool) -> str:
    """A warning that a checkpoint was trained on some of the evaluated scenes.

    Args:
        path: folder of the checkpoint.
        scenes: names of the scenes that it was trained on and is evaluated on.
        total: number of scenes that it is evaluated on.
        allowed: whether ``--allow-training-scenes`` was given.
    """
    ranges = [" to ".join([entry] if isinstance(entry, str) else entry) for entry in name_ranges(scenes)]
    names = ", ".join(ranges[:MOST_SCENES]) + ", …" * (len(ranges) > MOST_SCENES)
    which = f"{len(scenes)} of these {total} scenes" if total > 1 else "the evaluated scene"
    flag = " (--allow-training-scenes)" * allowed
    return f"{run_folder(Path(path))} was trained on {which} ({names}); its figures are not of unseen scenes{flag}"


def unknown_scenes_lines(results: EvalResults) -> list[str]:
    """A line for each checkpoint of which it is not known whether it was trained on the evaluated scenes.

    Results of earlier versions do not say it of any.
    """
    return [
        f"{run_folder(Path(record.path or record.name))}: {known_scenes(record)}; the evaluated ones may be among them"
        for record in results.checkpoints
        if (scenes := record.training_scenes) is None or not scenes.complete or scenes.evaluated is None
    ]


def known_scenes(record: CheckpointRecord) -> str:
    """Say how many scenes a checkpoint was trained on, as far as it is known."""
    scenes = record.training_scenes
    if scenes is None or not (scenes.complete or scenes.known):
        return "training scenes unknown"
    return (
        f"{scenes.known} training scenes" if scenes.complete else f"training scenes not all known ({scenes.known} are)"
    )


def all_left_out(results: EvalResults) -> dict[str, list[str]]:
    """What all tables leave out, by the reason; what only some of them leave out, with the name of each."""
    merged: dict[str, list[str]] = {}
    tables = compact_tables(results)
    left_out = [{name for names in table.left_out.values() for name in names} for table in tables]
    everywhere = set.intersection(*left_out) if left_out else set()
    for table in tables:
        for reason, names in table.left_out.items():
            told = [name if name in everywhere else f"{name} of {table.view.name}" for name in names]
            merged[reason] = list(dict.fromkeys([*merged.get(reason, []), *told]))
    return merged


def _together(left_out: dict[str, list[str]]) -> dict[str, list[str]]:
    """The same with all weights that one command fetches under one reason."""
    weights = {reason: match for reason in left_out if (match := FETCH.fullmatch(reason))}
    merged: dict[str, list[str]] = {}
    for options in dict.fromkeys(match["options"] for match in weights.values()):
        alike = [reason for reason, match in weights.items() if match["options"] == options]
        command = " ".join([weights[alike[0]]["command"], *(weights[reason]["name"] for reason in alike)])
        merged[f"weights are not here: {command}{options}"] = [name for reason in alike for name in left_out[reason]]
    return {reason: names for reason, names in left_out.items() if reason not in weights} | merged
