"""The tables of a benchmark of plans, as Markdown and on the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from persist_cli.bench.figure_text import markdown_table
from persist_cli.bench.plans.plan_bench import LOOPS
from persist_cli.bench.plans.results import COLUMNS
from persist_cli.output.console import print_table, say

SHORT: Final = (
    "success",
    "spl",
    "soft_spl",
    "reached",
    "wrong_stop",
    "missed_stop",
    "collisions",
    "seconds_per_decision",
    "writing_per_decision",
    "ate",
    "rpe",
    "sim",
)


def columns_of(table: Mapping[str, Any], names: Sequence[str]) -> list[str]:
    """Return those of some columns that a row of the table has."""
    return [name for name in names if any(name in row for row in table["rows"].values())]


def counted(table: Mapping[str, Any]) -> str:
    """Return how many episodes of how many scenes a table is of."""
    return f"{len(table['episodes'])} episodes, {table['scenes']} scenes"


def loop_columns(loop: str) -> list[str]:
    """Return the columns that are measured in a loop."""
    return [name for name, column in COLUMNS.items() if column.loop == loop]


def group_text(table: Mapping[str, Any]) -> str:
    """Return the figures of each loop and the differences over the episodes of one kind, as Markdown."""
    parts = [f"## {table['name']} ({counted(table)})"]
    for loop in LOOPS:
        names = columns_of(table, loop_columns(loop))
        if names:
            parts.append(markdown_table([f"row ({loop} loop)", *headings(names)], row_cells(table, names)))
    differences = difference_rows(table)
    if differences:
        parts.append(markdown_table(["difference", *headings(difference_columns(table))], differences))
    return "\n\n".join(parts)


def row_cells(table: Mapping[str, Any], names: Sequence[str]) -> list[list[str]]:
    """Return the name and the figures of each row."""
    return [[row, *(COLUMNS[name].cell(figures.get(name)) for name in names)] for row, figures in table["rows"].items()]


def headings(names: Sequence[str]) -> list[str]:
    """Return the heads of some columns."""
    return [COLUMNS[name].heading for name in names]


def difference_columns(table: Mapping[str, Any]) -> list[str]:
    """Return the columns whose differences are shown."""
    return columns_of(table, ("success", "spl", "soft_spl", "collisions", "ate", "rpe", "sim", "lpips"))


def difference_rows(table: Mapping[str, Any]) -> list[list[str]]:
    """Return the rows of a table of paired differences."""
    rows = []
    for row, figures in table["rows"].items():
        others = dict.fromkeys(other for figure in figures.values() for other in figure["differences"])
        for other in others:
            gaps = [figures.get(name, {}).get("differences", {}).get(other) for name in difference_columns(table)]
            texts = [COLUMNS[name].gap(value) for value, name in zip(gaps, difference_columns(table), strict=True)]
            rows.append([f"{row} − {other}", *texts])
    return rows


def success_rows(results: Mapping[str, Any], name: str = "success") -> tuple[list[str], list[list[str]]]:
    """Return heads and rows of one figure by bin and sight."""
    kinds = [table for table in results["tables"] if table["bin"] is not None and table["in_sight"] is not None]
    heads = [f"{table['bin']} {'in sight' if table['in_sight'] else 'hidden'}" for table in kinds]
    rows = [
        [row["name"], *(COLUMNS[name].cell(table["rows"][row["name"]].get(name), interval=False) for table in kinds)]
        for row in results["rows"]
    ]
    return ["row", *heads], rows


def tables_text(results: Mapping[str, Any]) -> str:
    """Return all tables with what their rows and columns mean, as Markdown."""
    settings = results["settings"]
    lines = [
        "# Plans in held-out scenes",
        f"{results['episodes']['count']} episodes of {len(results['episodes']['scenes'])} scenes; in brackets 95 % "
        "intervals by bootstrap over scenes; * leaves zero out.",
        "\n".join(f"- {line}." for line in settings["stop"]),
        f"- {settings['sim']['definition']}.",
        "## Rows",
        "\n".join(f"- **{row['name']}**: {row['definition']}" for row in results["rows"]),
        "## Columns",
        "\n".join(f"- **{column['title']}** ({column['loop']} loop): {column['definition']}"
                  for column in results["columns"].values()),
        "## Success by kind of goal",
        markdown_table(*success_rows(results)),
        *map(group_text, results["tables"]),
    ]  # fmt: skip
    return "\n\n".join(lines) + "\n"


def print_results(results: Mapping[str, Any]) -> None:
    """Print the table over all episodes, and success by kind of goal."""
    table = results["tables"][0]
    names = columns_of(table, SHORT)
    print_table(f"Plans, {counted(table)}", ["row", *headings(names)], row_cells(table, names))
    if "closed" in results["settings"]["loops"]:
        print_table("Success by actions of the shortest way", *success_rows(results))
    for line in results["settings"]["stop"]:
        say(f"{line}.")
