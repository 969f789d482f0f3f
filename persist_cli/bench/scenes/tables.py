"""The tables of a benchmark of scenes, as Markdown and on the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from persist_cli.bench.figure_text import FigureColumn, markdown_table
from persist_cli.bench.scenes import completion_part, edit_part, evolution_part, return_part, speed_part, walk_part
from persist_cli.output.console import print_table, say

SHORT: Final = ("miou", "structure", "iou", "doors", "leading", "open", "disagreement", "seconds")

IOU: Final = FigureColumn("IoU", "higher", True, "intersection over union")

Table = tuple[str, list[str], list[list[str]]]  # title, heads and rows


def completion_table(part: Mapping[str, Any], names: Sequence[str]) -> Table:
    """Return the table of all rows."""
    columns = completion_part.COLUMNS
    shown = [name for name in names if any(name in row["figures"] for row in part["rows"].values())]
    rows = [
        [name, *(columns[column].cell(row["figures"].get(column)) for column in shown)]
        for name, row in part["rows"].items()
    ]
    title = f"Cells that {part['images']} images do not show, within {part['radius']:g} m of the camera"
    return title, ["row", *(columns[name].heading for name in shown)], rows


def class_table(part: Mapping[str, Any]) -> Table:
    """Return intersection over union of each class and row."""
    names = ["free", "outside", *part["classes"]]
    rows = [
        [name, *(IOU.cell(row["class_iou"][one], interval=False) for one in names)]
        for name, row in part["rows"].items()
    ]
    return "IoU by class", ["row", *names], rows


def difference_table(part: Mapping[str, Any]) -> Table | None:
    """Return the paired differences of the model to other rows; ``None`` without a model."""
    columns = completion_part.COLUMNS
    figures = part["rows"].get("model", {}).get("figures", {})
    shown = [
        name for name in ("miou", "structure", "iou", "free_iou", "outside_iou", "leading", "open") if name in figures
    ]
    others = list(figures["miou"]["differences"]) if figures else []
    rows = [
        [f"model − {other}", *(columns[name].gap(figures[name]["differences"].get(other)) for name in shown)]
        for other in others
    ]
    heads = ["difference", *(columns[name].heading for name in shown)]
    return ("Paired differences; * leaves zero out", heads, rows) if rows else None


def part_table(
    title: str, first: str, rows: Mapping[str, Mapping[str, Any]], columns: Mapping[str, FigureColumn]
) -> Table:
    """Return a table of all figures of some rows.

    Args:
        title: of the table.
        first: head of the column with the rows' names.
        rows: figures by column, of each row.
        columns: in their order.
    """
    lines = [[name, *(columns[column].cell(row.get(column)) for column in columns)] for name, row in rows.items()]
    return title, [first, *(column.heading for column in columns.values())], lines


def other_tables(results: Mapping[str, Any]) -> list[Table]:
    """Return the tables of the parts that have one each."""
    found = []
    if "walk" in results:
        part = results["walk"]
        title = f"Walks in imagined scenes from {len(part['views'])} images"
        found.append(part_table(title, "steps", part["windows"], walk_part.COLUMNS))
    if "return" in results:
        part = results["return"]
        title = f"{part['steps']} frames out and as many back, from {len(part['views'])} images"
        found.append(part_table(title, "row", part["rows"], return_part.COLUMNS))
    if "edits" in results:
        part = results["edits"]
        rows = {f"{name} ({row['count']})": row for name, row in part["rows"].items()}
        found.append(part_table(f"Random edits, drawn by {part['adapter']!r}", "edits", rows, edit_part.COLUMNS))
    if "evolution" in results:
        part = results["evolution"]
        rows = {
            f"{name}, {group} ({figures['count']})": figures
            for name, groups in part["rows"].items()
            for group, figures in groups.items()
        }
        found.append(part_table("What becomes of true cells by an interaction", "row", rows, evolution_part.COLUMNS))
    if "speed" in results:
        part = results["speed"]
        title = f"Cost of a completion, {part['threads']} threads"
        found.append(part_table(title, "radius", part["rows"], speed_part.COLUMNS))
    return found


def tables(results: Mapping[str, Any], short: bool) -> list[Table]:
    """Return the tables of all parts that were measured; ``short`` for a terminal."""
    found: list[Table | None] = []
    if "completion" in results:
        part = results["completion"]
        found.append(completion_table(part, SHORT if short else tuple(completion_part.COLUMNS)))
        found += [] if short else [class_table(part), difference_table(part)]
    return [table for table in found if table is not None] + other_tables(results)


def definitions(results: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return names and definitions of rows and columns."""
    found = []
    if "completion" in results:
        part = results["completion"]
        found += [(name, row["definition"]) for name, row in part["rows"].items()]
        found += [(column.title, part["columns"][name]) for name, column in completion_part.COLUMNS.items()]
    if "evolution" in results:
        part = results["evolution"]
        found += [(f"{name} (evolution)", definition) for name, definition in part["definitions"].items()]
    for module in (walk_part, return_part, edit_part, evolution_part, speed_part):
        if module.PART in results:
            found += [(f"{column.title} ({module.PART})", column.definition) for column in module.COLUMNS.values()]
    return found


def tables_text(results: Mapping[str, Any]) -> str:
    """Return all tables with what their rows and columns mean, as Markdown."""
    lines = [
        "# Imagined scenes in held-out houses",
        "In brackets 95 % intervals by bootstrap over houses.",
        *(f"## {title}\n\n{markdown_table(heads, rows)}" for title, heads, rows in tables(results, short=False)),
        *missing_lines(results),
        "## Definitions",
        "\n".join(f"- **{name}**: {text}." for name, text in definitions(results)),
    ]
    return "\n\n".join(lines) + "\n"


def missing_lines(results: Mapping[str, Any]) -> list[str]:
    """Return for each figure that could not be measured a line that says why."""
    return [f"Not measured: {reason}." for reason in results.get("return", {}).get("missing", ())]


def print_results(results: Mapping[str, Any]) -> None:
    """Print the most important tables."""
    for title, heads, rows in tables(results, short=True):
        print_table(title, heads, rows)
    for line in missing_lines(results):
        say(line)
    if "completion" in results:
        part = results["completion"]
        say(f"mIoU over {', '.join(part['classes'])}; {part['cells']} cells, {part['unseen']}")
        if part["ratio"] is not None:
            say(f"mIoU of the model: {part['ratio']:.2f} times that of {part['best_baseline']!r}, the best without one")
