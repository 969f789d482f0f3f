"""The tables for a paper, in LaTeX with booktabs."""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Sequence

from persist_cli.evaluate.report.remarks import (
    contamination_lines,
    counted,
    drawn_units,
    left_out_line,
    new_poses_line,
    other_samplings,
    sampling_line,
    seed_legend,
    too_few_lines,
    without_command,
)
from persist_cli.evaluate.report.result_file import EvalResults
from persist_cli.evaluate.report.tables import CellView, CompactTable, RowView, TableView, compact_tables
from persist_cli.evaluate.report.text import fit_columns

SPECIAL = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "#": r"\#", "_": r"\_", "%": r"\%",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": "$<$", ">": "$>$",
    "|": r"$|$", '"': "''", "±": r"$\pm$", "−": "$-$", "×": r"$\times$", "°": r"$^\circ$",
    "↑": r"$\uparrow$", "↓": r"$\downarrow$", "→": r"$\rightarrow$", "≥": r"$\geq$", "≤": r"$\leq$", "–": "--",
    "—": "---", "…": r"\ldots{}", "·": r"$\cdot$", "∞": r"$\infty$", "√": r"$\surd$", "≈": r"$\approx$",
    "²": "$^2$", "³": "$^3$", "’": "'", "‘": "`", "“": "``", "”": "''",
}  # fmt: skip

CellWriter = Callable[[CellView], list[str]]  # gives the lines of a cell

Groups = list[tuple[str, list[RowView]]]

PAGE, HALF_PAGE = 108, 60  # characters that fit beside each other, with three more for each column

LINE_END = " \\\\"

HEAD = "% \\usepackage{booktabs} in the preamble; \\input{table} where the tables belong.\n"


def latex_tables(results: EvalResults) -> str:
    """A ``table`` with mean ± deviation and one with differences for each table of the results."""
    blocks = []
    for number, table in enumerate(compact_tables(results)):
        view = table.view
        rows = [row for row in view.rows if any(cell.difference for cell in row.cells)]
        label = f"tab:persist-{number}" if number else "tab:persist"
        blocks.append(_float(view, view.kind_groups(), _figure, _caption(results, table), label))
        if rows:
            caption = f"Paired difference to {escape(results.first_row or '')}"
            if table.has_intervals:
                caption += f" with 95\\,\\% interval (bootstrap over {drawn_units(results)})"
                caption += "; $^*$ the interval leaves zero out"
            caption += "".join(f". {escape(line)}" for line in too_few_lines(view)) + "."
            groups = [(title, [row for row in group if row in rows]) for title, group in view.kind_groups()]
            groups = [(title, group) for title, group in groups if group]
            blocks.append(_float(view, groups, _difference, caption, f"{label}-differences"))
        if table.left_out:
            blocks.append(_comment(left_out_line(table.left_out, commands=False)))
    warnings = [_comment(f"warning: {line}") for line in contamination_lines(results)]
    return HEAD + "\n".join([*warnings, _comment(new_poses_line(results)), *blocks])


def _comment(text: str) -> str:
    """A comment of LaTeX; a name with a line end in it does not end it."""
    return f"% {' '.join(text.split())}\n"


def escape(text: str) -> str:
    """Text that LaTeX prints as it stands; Greek letters become mathematics, control characters blanks."""
    return "".join(_escape_character(character) for character in text)


def _escape_character(character: str) -> str:
    if character in SPECIAL:
        return SPECIAL[character]
    if unicodedata.category(character).startswith("C"):
        return " "
    name = unicodedata.name(character, "").split()
    if name[:1] == ["GREEK"] and name[2:3] == ["LETTER"] and len(name) == 4 and len(name[3]) > 1:
        return _greek(name[3].lower(), capital=name[1] == "CAPITAL")
    return character


def _greek(letter: str, capital: bool) -> str:
    letters = "alpha beta gamma delta epsilon zeta eta theta iota kappa mu nu xi pi rho sigma tau phi chi psi omega"
    capitals = "gamma delta theta xi pi sigma phi psi omega"
    letter = {"lamda": "lambda"}.get(letter, letter)
    if letter not in [*(capitals if capital else letters).split(), "lambda"]:
        return "?"
    return f"$\\{letter.capitalize() if capital else letter}$"


def _caption(results: EvalResults, table: CompactTable) -> str:
    view = table.view
    measured, protocol = results.measured, results.measured.protocol
    height, width = measured.image_size
    domain = f" ({view.name})" if len(results.tables) > 1 else ""
    clips = f"{counted(view.clips, 'clips')} of {protocol.frames} frames at {height}×{width}"
    clips += f", {counted(view.units, 'scenes')}" * (view.unit == "scenes")
    notes = [f"({number}) {without_command(note)}" for number, note in view.notes.items()]
    sampled = "".join(f"; {line}" for line in (sampling_line(results), *other_samplings(results)) if line)
    text = f"{protocol.title or protocol.name}{domain}: {clips}; {seed_legend(results)}{sampled}"
    return escape(" ".join(f"{sentence}." for sentence in [text, *notes]))


def _figure(cell: CellView) -> list[str]:
    text = escape(cell.text) + (f"$^{{({cell.note})}}$" if cell.note else "")
    return [f"\\textbf{{{text}}}" if cell.best else text]


def _difference(cell: CellView) -> list[str]:
    marked = escape(cell.difference.rstrip("*")) + ("$^*$" if cell.difference.endswith("*") else "")
    return [marked, f"\\scriptsize {escape(cell.difference_interval)}" if cell.difference_interval else ""]


def _float(view: TableView, groups: Groups, write_cell: CellWriter, caption: str, label: str) -> str:
    """A LaTeX float; columns that do not fit the page's width go into further floats."""
    rows = [row for _, group in groups for row in group]
    plain = [[row.label, *(_plain_text(cell, write_cell) for cell in row.cells)] for row in rows]
    heads = ["", *(column.heading for column in view.columns)]
    blocks = [[number - 1 for number in columns[1:]] for columns in fit_columns(heads, plain, PAGE)]
    form = "table" if next(fit_columns(heads, plain, HALF_PAGE)) == list(range(len(heads))) else "table*"
    head = f"\\begin{{{form}}}\n\\centering\n\\footnotesize\n\\setlength{{\\tabcolsep}}{{4pt}}\n"
    floats = []
    for place, columns in enumerate(blocks):
        names = f"\\caption{{{caption if not place else 'The table before, further columns.'}}}\n"
        names += f"\\label{{{label}{f'-{place}' * bool(place)}}}\n"
        floats.append(f"{head}{names}{_tabular(view, groups, write_cell, columns)}\n\\end{{{form}}}\n")
    return "\n".join(floats)


def _tabular(view: TableView, groups: Groups, write_cell: CellWriter, columns: Sequence[int]) -> str:
    heads = [view.columns[number] for number in columns]
    lines = [f"\\begin{{tabular}}{{@{{}}l{'r' * len(columns)}@{{}}}}", "\\toprule"]
    lines.append(" & ".join(["", *(escape(head.heading) for head in heads)]) + LINE_END)
    for _, rows in groups:
        lines.append("\\midrule")
        for row in rows:  # the braces keep a name that begins with [ from being the argument of the line before
            texts = zip(*(write_cell(row.cells[number]) for number in columns), strict=True)
            names = [f"{{{escape(row.label)}}}", ""]
            filled = [(name, line) for name, line in zip(names, texts, strict=False) if any(line)]
            lines += [" & ".join([name, *line]) + LINE_END for name, line in filled]
            lines += ["\\addlinespace[2pt]"] if write_cell is _difference else []
    return "\n".join([*lines, "\\bottomrule", "\\end{tabular}"])


def _plain_text(cell: CellView, write_cell: CellWriter) -> str:
    return cell.text if write_cell is _figure else f"{cell.difference}\n{cell.difference_interval}"
