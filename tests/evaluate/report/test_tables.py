"""The tables on the console, as Markdown and as LaTeX."""

from __future__ import annotations

import math
import re
import shutil
import subprocess
from io import StringIO

import pytest
from rich.console import Console
from rich.table import Table

from persist_cli.evaluate.report.latex import latex_tables
from persist_cli.evaluate.report.result_file import Difference, check_results
from persist_cli.evaluate.report.tables import difference_texts, digits_of, number_text, verdict, view_tables
from persist_cli.evaluate.report.text import console_tables, print_tables, table_text
from tests.support.example_results import DREAMSIM, ROWS, example_results

LATEX = r"\documentclass{article}\usepackage{booktabs}\begin{document}\input{table}\end{document}"

HOSTILE = r"[bold]\x{y}$z$_%&#~^<script>|`*é σ ± 2° " + "\n\x00"


def cells_of(row: str, column: str, results=None):
    """The view of one cell."""
    checked = check_results(results or example_results(), "example")
    view = view_tables(checked)[0]
    return next(row_view for row_view in view.rows if row_view.name == row).cells[list(checked.columns).index(column)]


@pytest.mark.parametrize(("value", "text"), [(22.456, "22.46"), (-0.001, "0.00"), (-3.0, "−3.00"), (None, "–")])
def test_a_number_has_a_true_minus_sign_and_no_negative_zero(value, text):
    assert number_text(value, 2) == text


@pytest.mark.parametrize(("usual", "digits"), [(194.0, 1), (22.0, 2), (0.3, 3), (0.042, 4), (0.0012, 5), (0.0, 2)])
def test_a_column_has_as_many_decimals_as_its_usual_value_needs(usual, digits):
    assert digits_of([usual, usual, None, 0.0, 1000 * usual]) == digits


def test_the_verdict_on_a_clear_difference_follows_the_direction_of_the_column():
    gap = Difference(mean=-0.1, low=-0.2, high=-0.05)
    assert (verdict(gap, "lower"), verdict(gap, "higher"), verdict(gap, None)) == ("better", "worse", "open")
    assert verdict(Difference(mean=-0.1, low=-0.2, high=0.0), "lower") == "open"
    assert verdict(Difference(mean=-0.1), "lower") == "open"


def test_a_clear_difference_never_reads_as_a_marked_zero():
    small = Difference(mean=0.00004, low=0.00003, high=0.00005)
    assert difference_texts(small, 3) == ("+0.00004*", "[+0.00003, +0.00005]")
    assert difference_texts(Difference(mean=1e-9, low=9e-10, high=2e-9), 3) == ("0.000", "[0.000, 0.000]")
    assert difference_texts(Difference(mean=0.00004, low=-0.1, high=0.1), 3)[0] == "0.000"


def test_only_model_rows_can_be_best():
    assert [cells_of(row, "psnr").best for row in ROWS] == [False, True, False, False, False]
    assert cells_of("voxel", "lpips-alex").best


def test_a_single_model_is_not_called_best():
    assert not cells_of("none", "psnr", example_results(rows={"none": "model", "copy": "control"})).best


def test_a_difference_whose_interval_leaves_zero_out_is_marked():
    assert cells_of("voxel", "psnr").difference == "+2.00*"
    assert cells_of("voxel, shuffled", "psnr").difference == "+0.10"
    assert cells_of("none", "psnr").difference == ""


def test_undefined_figures_are_dashes_and_never_best():
    results = example_results()
    results["tables"][0]["rows"]["voxel"]["columns"]["psnr"] |= {"mean": math.nan, "std": math.nan, "low": None}
    cell = cells_of("voxel", "psnr", results)
    assert (cell.text, cell.interval, cell.best) == ("–", "", False)


def test_each_reason_of_a_missing_figure_is_one_footnote():
    results = example_results()
    for row in ("none", "voxel"):
        results["tables"][0]["rows"][row]["columns"]["src"] = {"na": "never returns"}
    text = table_text(results)
    assert (text.count("n/a (1) |"), text.count("n/a (1): never returns"), text.count("never returns")) == (2, 1, 1)


def test_a_column_without_figures_is_one_line_in_the_text_and_a_footnote_on_the_page():
    assert table_text(example_results()).count(f"DreamSim ↓: n/a ({DREAMSIM})") == 1
    assert "n/a (1) |" not in table_text(example_results())
    assert cells_of("none", "dreamsim").note == 1


def test_markdown_tables_stay_whole_when_a_row_name_holds_markup():
    text = table_text(example_results(rows={"none": "model", HOSTILE: "control"}))
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert len({len(re.findall(r"(?<!\\)\|", line)) for line in rows}) == 1
    assert "<script>" not in text


def test_console_tables_fit_the_console_and_keep_every_column():
    for width in (50, 80, 160):
        tables = console_tables(example_results(), width)
        assert {head for _, heads, _ in tables for head in heads} >= {"PSNR ↑", "SSIM ↑", "LPIPS ↓", "PSNR last ↑"}
        for _, heads, cells in tables:
            table = Table(*heads)
            for row in cells:
                table.add_row(*row)
            assert table.__rich_measure__(Console(width=500), Console(width=500).options).maximum <= width


def test_a_row_name_that_looks_like_markup_is_printed_literally(monkeypatch):
    printed = Console(file=StringIO(), width=160)
    monkeypatch.setattr("persist_cli.viewing.console.OUT", printed)
    print_tables(example_results(rows={"none": "model", "[bold]x[/red]": "control"}))
    assert "[bold]x[/red]" in printed.file.getvalue()
    assert "difference to none" in printed.file.getvalue()


def test_latex_tables_have_a_cell_for_each_column_in_every_row():
    results = check_results(example_results(rows={"none": "model", HOSTILE: "control"}), "example")
    lines = [line for line in latex_tables(results).splitlines() if " & " in line]
    columns = re.findall(r"begin{tabular}{@{}l(r+)", latex_tables(results))
    assert {len(re.findall(r"(?<!\\)&", line)) for line in lines} == {len(letters) for letters in columns}
    assert latex_tables(results).count(r"\toprule") == latex_tables(results).count(r"\end{tabular}") > 1


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no pdflatex on this machine")
def test_the_latex_compiles_when_a_row_name_holds_special_characters(tmp_path):
    results = example_results(rows={"none": "model", HOSTILE: "model", "[b] σ Ω": "control"})
    (tmp_path / "table.tex").write_text(latex_tables(check_results(results, "example")), encoding="utf-8")
    (tmp_path / "paper.tex").write_text(LATEX, encoding="utf-8")
    command = ["pdflatex", "-halt-on-error", "-interaction=nonstopmode", "paper.tex"]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, errors="replace", timeout=120)
    assert ended.returncode == 0, ended.stdout[-2000:]
