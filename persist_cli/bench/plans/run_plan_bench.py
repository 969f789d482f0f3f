"""``persist bench plan`` from its options to its tables and report."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from persist_cli.bench.plans.pictures import picture_episodes
from persist_cli.bench.plans.plan_bench import BenchPlan, prepare, run_rows
from persist_cli.bench.plans.report import MAPS, PAGE, write_planning_report
from persist_cli.bench.plans.results import results_json
from persist_cli.bench.plans.tables import print_results, tables_text
from persist_cli.evaluate.processes import Processes
from persist_cli.io.exclusive import exclusive
from persist_cli.io.files import check_folder, write_json, write_text
from persist_cli.output.console import busy, print_json, say

RESULTS: Final = "metrics.json"

TABLES: Final = "tables.md"


def run_plan_bench(plan: BenchPlan, out: Path, report: Path | None, json: bool) -> None:
    """Run all rows and write ``metrics.json`` and ``tables.md``, and a report where a folder is named.

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
    processes = Processes()
    with exclusive(out, processes.main):
        bench = prepare(plan, out, processes)
        run_rows(bench, processes)
        if not processes.main:
            return
        results = results_json(bench, processes.count)
        write_json(out / RESULTS, results)
        write_text(out / TABLES, tables_text(results))
        if report is not None:
            with busy("drawing episodes"):
                write_planning_report(results, picture_episodes(bench, report / MAPS), report)
        if json:
            print_json(results)
            return
        print_results(results)
        say(f"all columns, kinds and differences: {out / TABLES}; every figure: {out / RESULTS}")
        if report is not None:
            say(f"with maps: {report / PAGE}")
