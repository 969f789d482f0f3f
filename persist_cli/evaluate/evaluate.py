"""``persist eval`` from its options to its table, results and report."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from persist_cli.api.checkpoint import PLAIN, reference_checkpoint
from persist_cli.data.mirror import address_of
from persist_cli.errors import PersistError
from persist_cli.evaluate.aggregate import Table, row_results
from persist_cli.evaluate.cases import Case, cases_json, counts
from persist_cli.evaluate.columns import column_json, make_columns
from persist_cli.evaluate.example_clips import make_pictures
from persist_cli.evaluate.measure import measure_rows
from persist_cli.evaluate.metric_suite import CELLS
from persist_cli.evaluate.plan import EvalPlan, Evaluation, contamination_warnings, prepare
from persist_cli.evaluate.processes import Processes
from persist_cli.evaluate.provenance import checkpoint_json, environment, metric_json, scenes_json
from persist_cli.evaluate.report.page import PAGE, write_report
from persist_cli.evaluate.report.result_file import check_results
from persist_cli.evaluate.report.scrutiny import scrutiny_json
from persist_cli.evaluate.report.terminal import print_results
from persist_cli.evaluate.report.text import table_text
from persist_cli.evaluate.rows.model_rows import ModelRow
from persist_cli.evaluate.statistics import LEAST_UNITS, RESAMPLES, SET_RESAMPLES
from persist_cli.evaluate.windows import SHOWN, window_bounds
from persist_cli.io.command_line import running_command
from persist_cli.io.exclusive import exclusive
from persist_cli.io.files import check_folder, write_json, write_text
from persist_cli.output.console import print_json, say

RESULTS = "metrics.json"

TABLES = "tables.md"

BOOTSTRAP = {"resamples": RESAMPLES, "set_resamples": SET_RESAMPLES}  # samples of means, and of distances between sets


def run_eval(paths: Sequence[Path], plan: EvalPlan, out: Path, report: Path | None, json: bool) -> None:
    """Measure all rows and write ``metrics.json`` and ``tables.md``, and a report where a folder is named.

    Args:
        paths: runs or checkpoints; when empty, the reference model is evaluated.
        plan: the options; ``sample`` among its data is the package's data set.
        out: folder of the evaluation.
        report: folder of the report, ``None`` for none.
        json: whether the results are printed as JSON instead of tables.

    Raises:
        PersistError: when no data are named, or what is named cannot be measured.
    """
    if not plan.data:
        raise PersistError("give --data DATA (--data sample comes with persist), or --compare A.json B.json")
    for folder in (out, report):
        if folder is not None:
            check_folder(folder)
    processes = Processes()
    with exclusive(out, processes.main):
        plan.folders  # noqa: B018  data that are not there are reported before a model is loaded
        run, loader = prepare(paths or [reference_checkpoint()], plan, out, processes)
        measure_rows(run, loader, processes)
        if not processes.main:
            return
        results = results_json(run, processes.count)
        results["scrutiny"] = scrutiny_json(check_results(results, "results"))
        write_json(out / RESULTS, results)
        write_text(out / TABLES, table_text(results))
        if report is not None:
            write_report(results, make_pictures(run, clips_by_domain(run), loader), report)
        if json:
            print_json(results)
            return
        print_results(results)
        say(motion_line(results["measured"]["clips"]))
        say(f"all columns, intervals and definitions: {out / TABLES}; every clip: {out / RESULTS}")
        if report is not None:
            say(f"with curves and videos: {report / PAGE}")


def results_json(run: Evaluation, processes: int) -> dict[str, Any]:
    """The results and all that is needed to measure them again, as JSON values."""
    info = run.cases[0].file.info
    counted, predicted = counts(run.cases)
    rows = row_results(run)
    return {
        "format": "persist-evaluation",
        "version": 1,
        "measured": {
            "protocol": {
                "name": run.protocol.name,
                "title": run.protocol.title,
                "definition": f"{run.protocol.definition}; {run.plan.new_poses.definition}",
                "frames": run.cases[0].frames,
                "new_poses": dataclasses.asdict(run.plan.new_poses),
                "counted_frames": counted,
                "predicted_frames": predicted,
            },
            "data": [data_json(data, run.cases) for data in run.journal.data()],
            "image_size": [info.height, info.width],
            "clips": cases_json(run.cases),
            "metrics": metric_json(run.metrics),
        },
        "sampling": {
            "chosen": sampling_origin(run),
            "steps": run.sampling.steps,
            "sampler": run.sampling.sampler,
            "memory_guidance": run.sampling.memory_guidance,
            "context_noise": run.sampling.context_noise,
            "autoguidance": run.sampling.autoguidance,
            "sampling_of": own_samplings(run),
            "seeds": list(range(run.plan.seeds)),
            "batch": run.plan.batch,
        }
        | run.plan.placement.changes(),
        "statistics": {"resampled": run.plan.resample, "least": LEAST_UNITS} | BOOTSTRAP,
        "warnings": contamination_warnings(run.checkpoints, run.cases),
        "training_scenes_allowed": run.plan.allow_training_scenes,
        "environment": environment(processes),
        "command": running_command(),
        "checkpoints": [
            checkpoint_json(checkpoint) | scenes_json(checkpoint, run.cases) for checkpoint in run.checkpoints
        ],
        "columns": column_json(make_columns(run.metrics, run.protocol)),
        "tables": [Table(run, name, clips).to_json(rows) for name, clips in clips_by_domain(run).items()],
        "first_row": run.rows[0].group,
        "windows": windows_json(run),
    }


def windows_json(run: Evaluation) -> dict[str, list[tuple[int, int]]]:
    """First and last frame of each window along the rollouts, by what has windows; none without rollouts.

    Cells are counted after every predicted clip.
    """
    if not run.protocol.writes:
        return {}
    frames = run.cases[0].frames
    bounds = {metric: window_bounds(frames) for metric in SHOWN if metric in run.metrics}
    return bounds | {CELLS: window_bounds(frames, run.predicted_at_once)}


def data_json(data: dict[str, Any], cases: Sequence[Case]) -> dict[str, Any]:
    """A data set of the journal with the splits of its trajectories, and its address where the folder mirrors one."""
    address = address_of(Path(data["path"]))
    return data | ({"address": address} if address else {}) | {"splits": splits_of(cases, data["path"])}


def splits_of(cases: Sequence[Case], folder: str) -> dict[str, str]:
    """The split of each trajectory of a folder that the cases use, where the data says it."""
    infos = {case.trajectory: case.file.info for case in cases if case.data == folder}
    return {name: str(info.source["split"]) for name, info in infos.items() if info.source.get("split")}


def own_samplings(run: Evaluation) -> dict[str, dict[str, Any]]:
    """The sampling of each memory whose rows are sampled in another way than the others, as JSON values."""
    rows = [row for row in run.rows if isinstance(row, ModelRow) and row.sampling != run.sampling]
    return {row.adapter or PLAIN: dataclasses.asdict(row.sampling) for row in rows}


def sampling_origin(run: Evaluation) -> str:
    """Where the sampling of the models comes from."""
    if run.plan.sampling.requested():
        return "named on the command line"
    checkpoint = run.checkpoints[0]
    if run.protocol.name in checkpoint.protocol_sampling:
        return f"the card's for the protocol {run.protocol.name}"
    return "the card's" if checkpoint.sampling else "the tool's default"


def clips_by_domain(run: Evaluation) -> dict[str, list[int]]:
    """Numbers of the clips of each table: all clips in one, or a table for each data set where the protocol says so."""
    if not run.protocol.domains:
        return {"all": list(range(len(run.cases)))}
    domains: dict[str, list[int]] = {}
    for number, case in enumerate(run.cases):
        source = case.file.info.source
        origin = source.get("simulator") or source.get("format") or "unknown origin"
        domains.setdefault(f"{case.data} ({origin})", []).append(number)
    return domains


def motion_line(clips: Sequence[dict[str, Any]]) -> str:
    """A line that says how far the clips move, because a frozen video scores well on clips that hardly do.

    Args:
        clips: ``measured.clips`` of the results.
    """
    metres, distance, degrees = (
        sum(clip[key] for clip in clips) / len(clips) for key in ("path_metres", "farthest_metres", "turned_degrees")
    )
    shares = [share for clip in clips for share in clip["seen_before"][1:] if share is not None]
    seen = f"; {sum(shares) / len(shares):.0%} of what they look at was seen before" if shares else ""
    return f"the clips are on average {metres:.1f} m long, {distance:.1f} m away, {degrees:.0f}° of turns{seen}"
