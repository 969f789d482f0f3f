"""``persist bench scene`` from its options to its tables and report."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from persist_cli.bench.scenes.completion_part import completion_json, run_completion
from persist_cli.bench.scenes.completions import CEILINGS, SceneCompletion
from persist_cli.bench.scenes.edit_part import edits_json, run_edits
from persist_cli.bench.scenes.evolution_part import evolution_json, run_evolution
from persist_cli.bench.scenes.plan_pictures import picture_views
from persist_cli.bench.scenes.report import PAGE, write_scene_report
from persist_cli.bench.scenes.return_part import return_json, run_returns
from persist_cli.bench.scenes.scene_bench import SceneBench, SceneBenchPlan, identity, part_identities, prepare
from persist_cli.bench.scenes.speed_part import run_speed, speed_json
from persist_cli.bench.scenes.tables import print_results, tables_text
from persist_cli.bench.scenes.walk_part import run_walks, walk_json
from persist_cli.evaluate.provenance import environment
from persist_cli.evaluate.statistics import LEAST_UNITS, RESAMPLES
from persist_cli.io.command_line import running_command
from persist_cli.io.exclusive import exclusive
from persist_cli.io.files import check_folder, write_json, write_text
from persist_cli.output.console import print_json, say

RESULTS: Final = "metrics.json"

TABLES: Final = "tables.md"

FORMAT, VERSION = "persist-scenes", 1


def run_scene_bench(plan: SceneBenchPlan, out: Path, report: Path | None, json: bool) -> None:
    """Run all parts and write ``metrics.json`` and ``tables.md``.

    Args:
        plan: the options.
        out: folder of the benchmark; a stopped one goes on.
        report: folder of the report, ``None`` for none.
        json: whether the results are printed as JSON instead of tables.

    Raises:
        PersistError: one line for whatever does not fit.
    """
    for folder in (out, report):
        if folder is not None:
            check_folder(folder)
    with exclusive(out):
        bench = prepare(plan, out)
        run_parts(bench)
        results = results_json(bench)
        write_json(out / RESULTS, results)
        write_text(out / TABLES, tables_text(results))
        if report is not None:
            pictures = picture_views(bench) if "completion" in plan.parts else []
            write_scene_report(results, pictures, report)
        if json:
            print_json(results)
            return
        print_results(results)
        say(f"all columns, classes and differences: {out / TABLES}; every figure: {out / RESULTS}")
        if report is not None:
            say(f"with plans: {report / PAGE}")


def run_parts(bench: SceneBench) -> None:
    """Run what the journal lacks of each part."""
    rendering = bench.plan.rendering
    if "completion" in bench.plan.parts:
        run_completion(bench)
    if "walk" in bench.plan.parts:
        run_walks(bench)
    if "speed" in bench.plan.parts:
        run_speed(bench)
    if "evolution" in bench.plan.parts:
        run_evolution(bench)
    if "return" in bench.plan.parts and rendering is not None:
        run_returns(bench, rendering)
    if "edits" in bench.plan.parts and rendering is not None:
        run_edits(bench, rendering)


def results_json(bench: SceneBench) -> dict[str, Any]:
    """Return the results and all that is needed to measure them again, as JSON values."""
    results: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "settings": identity(bench.plan, bench.views) | {"model": bench.plan.model, "seeds": bench.plan.seeds},
        "parts": part_identities(bench.plan, bench.houses, bench.trained),
        "views": [view.name for view in bench.views],
        "scenes": [view.scene for view in bench.views],
        "training_houses": [house.scene for house in bench.houses],
        "palette": bench.palette,
        "statistics": {"resamples": RESAMPLES, "least_houses": LEAST_UNITS, "drawn": "houses"},
        "environment": environment(1),
        "command": running_command(),
    }
    rendering = bench.plan.rendering
    if "completion" in bench.plan.parts:
        results["completion"] = completion_json(bench) | {"radius": bench.plan.radius}
        results["completion"] |= against_baselines(results["completion"])
    if "walk" in bench.plan.parts:
        results["walk"] = walk_json(bench)
    if "speed" in bench.plan.parts:
        results["speed"] = speed_json(bench)
    if "evolution" in bench.plan.parts:
        results["evolution"] = evolution_json(bench)
    if "return" in bench.plan.parts and rendering is not None:
        results["return"] = return_json(bench, rendering)
    if "edits" in bench.plan.parts and rendering is not None:
        results["edits"] = edits_json(bench, rendering)
    return results


def against_baselines(part: dict[str, Any]) -> dict[str, Any]:
    """Return the best row by mIoU that has no model and no truth, and how many times as good the model is.

    The ratio is ``None`` without a model, or where the best row has nothing right.
    """
    means = {name: row["figures"]["miou"]["mean"] for name, row in part["rows"].items()}
    model = means.pop(SceneCompletion.name, None)
    best = max((name for name in means if name not in CEILINGS), key=lambda name: means[name] or 0.0)
    ratio = model / means[best] if model is not None and means[best] else None
    return {"best_baseline": best, "ratio": ratio}
