"""The tables for a paper: LaTeX with booktabs."""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Sequence

from persist_cli.evaluate.report.result_file import Evaluation
from persist_cli.evaluate.report.tables import CellView, CompactTable, RowView, TableView, compact_tables
from persist_cli.evaluate.report.text import fitting

SPECIAL = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "#": r"\#", "_": r"\_", "%": r"\%",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": "$<$", ">": "$>$",
    "|": r"$|$", '"': "''", "±": r"$\pm$", "−": "$-$", "×": r"$\times$", "°": r"$^\circ$",
    "↑": r"$\uparrow$", "↓": r"$\downarrow$", "→": r"$\rightarrow$", "≥": r"$\geq$", "≤": r"$\leq$", "–": "--",
    "—": "---", "…": r"\ldots{}", "·": r"$\cdot$", "∞": r"$\infty$", "√": r"$\surd$", "≈": r"$\approx$",
    "²": "$^2$", "³": "$^3$", "’": "'", "‘": "`", "“": "``", "”": "''",
}  # fmt: skip

Texts = Callable[[CellView], list[str]]  # the lines of a cell

Groups = list[tuple[str, list[RowView]]]

PAGE, HALF_PAGE = 108, 60  # signs, with three more a column, that fit beside each other

END = " \\\\"  # of a tabular's line

HEAD = "% \\usepackage{booktabs} in the preamble; \\input{table} where the tables belong.\n"


def latex_tables(results: Evaluation) -> str:
    """A ``table`` with mean ± deviation and one with differences for each table of the results."""
    blocks = []
    for number, table in enumerate(compact_tables(results)):
        view = table.view
        rows = [row for row in view.rows if any(cell.difference for cell in row.cells)]
        label = f"tab:persist-{number}" if number else "tab:persist"
        blocks.append(_float(view, view.kind_groups(), _figure, _caption(results, table), label))
        if rows:
            caption = (
                f"Paired difference to {escape(results.first_row or '')} with 95\\,\\% interval (bootstrap over "
                "clips); $^*$ the interval leaves zero out."
            )
            groups = [(title, kept) for title, group in view.kind_groups() if (kept := [x for x in group if x in rows])]
            blocks.append(_float(view, groups, _difference, caption, f"{label}-differences"))
    return HEAD + "\n".join(blocks)


def escape(text: str) -> str:
    """Text that LaTeX prints as it stands; Greek letters become mathematics, control characters blanks."""
    return "".join(_sign(sign) for sign in text)


def _sign(sign: str) -> str:
    if sign in SPECIAL:
        return SPECIAL[sign]
    if unicodedata.category(sign).startswith("C"):
        return " "
    name = unicodedata.name(sign, "").split()
    if name[:1] == ["GREEK"] and name[2:3] == ["LETTER"] and len(name) == 4 and len(name[3]) > 1:
        return _greek(name[3].lower(), capital=name[1] == "CAPITAL")
    return sign


def _greek(letter: str, capital: bool) -> str:
    known = "alpha beta gamma delta epsilon zeta eta theta iota kappa mu nu xi pi rho sigma tau phi chi psi omega"
    capitals = "gamma delta theta xi pi sigma phi psi omega"
    letter = {"lamda": "lambda"}.get(letter, letter)
    if letter not in [*(capitals if capital else known).split(), "lambda"]:
        return "?"
    return f"$\\{letter.capitalize() if capital else letter}$"


def _caption(results: Evaluation, table: CompactTable) -> str:
    view = table.view
    measured, protocol = results.measured, results.measured.protocol
    height, width = measured.image_size
    seeds = len(results.sampling.seeds)
    which = f" ({view.name})" if len(results.tables) > 1 else ""
    clips = f"{view.clips} clips of {protocol.frames} frames at {height}×{width}"
    notes = "".join([f" ({number}) {note}." for number, note in view.notes.items()] + [f" {x}." for x in table.absent])
    text = f"{protocol.title or protocol.name}{which}: {clips}"
    return escape(f"{text}; mean ± standard deviation over {seeds} sampling seed{'s' * (seeds != 1)}.{notes}")


def _figure(cell: CellView) -> list[str]:
    text = escape(cell.text) + (f"$^{{({cell.note})}}$" if cell.note else "")
    return [f"\\textbf{{{text}}}" if cell.best else text]


def _difference(cell: CellView) -> list[str]:
    marked = escape(cell.difference.rstrip("*")) + ("$^*$" if cell.difference.endswith("*") else "")
    return [marked, f"\\scriptsize {escape(cell.difference_interval)}"]


def _float(view: TableView, groups: Groups, text: Texts, caption: str, label: str) -> str:
    """A float; columns that do not fit the page's width go into further ones."""
    rows = [row for _, group in groups for row in group]
    plain = [[row.name, *(_widest(cell, text) for cell in row.cells)] for row in rows]
    heads = ["", *(column.heading for column in view.columns)]
    blocks = [[number - 1 for number in chosen[1:]] for chosen in fitting(heads, plain, PAGE)]
    form = "table" if next(fitting(heads, plain, HALF_PAGE)) == list(range(len(heads))) else "table*"
    head = f"\\begin{{{form}}}\n\\centering\n\\footnotesize\n\\setlength{{\\tabcolsep}}{{4pt}}\n"
    floats = []
    for place, columns in enumerate(blocks):
        names = f"\\caption{{{caption if not place else 'The table before, further columns.'}}}\n"
        names += f"\\label{{{label}{f'-{place}' * bool(place)}}}\n"
        floats.append(f"{head}{names}{_tabular(view, groups, text, columns)}\n\\end{{{form}}}\n")
    return "\n".join(floats)


def _tabular(view: TableView, groups: Groups, text: Texts, columns: Sequence[int]) -> str:
    heads = [view.columns[number] for number in columns]
    lines = [f"\\begin{{tabular}}{{@{{}}l{'r' * len(columns)}@{{}}}}", "\\toprule"]
    lines.append(" & ".join(["", *(escape(head.heading) for head in heads)]) + END)
    for _, rows in groups:
        lines.append("\\midrule")
        for row in rows:  # the braces keep a name that begins with [ from being the argument of the line before
            texts = zip(*(text(row.cells[each]) for each in columns), strict=True)
            names = [f"{{{escape(row.name)}}}", ""]
            lines += [" & ".join([name, *line]) + END for name, line in zip(names, texts, strict=False)]
            lines += ["\\addlinespace[2pt]"] if text is _difference else []
    return "\n".join([*lines, "\\bottomrule", "\\end{tabular}"])


def _widest(cell: CellView, text: Texts) -> str:
    return cell.text if text is _figure else f"{cell.difference}\n{cell.difference_interval}"
