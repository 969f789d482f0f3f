"""The tables on the console, as Markdown and as LaTeX."""

from __future__ import annotations

import math
import re
import shutil
import subprocess

import pytest

from persist_cli.evaluate.report.latex import latex_tables
from persist_cli.evaluate.report.result_file import Difference, check_results
from persist_cli.evaluate.report.tables import difference_texts, digits_of, number_text, verdict, view_tables
from persist_cli.evaluate.report.text import table_text
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


def test_a_column_without_figures_is_left_out_and_named_in_one_line():
    text, latex = table_text(example_results()), latex_tables(check_results(example_results(), "example"))
    assert text.count("DreamSim") == 1
    assert "- left out: DreamSim (weights are not here: persist weights fetch dreamsim)" in text
    assert latex.count("DreamSim") == 1
    assert "% left out: DreamSim (weights dreamsim are not here)" in latex


def test_captions_name_no_command():
    results = example_results()
    results["tables"][0]["rows"]["none"]["columns"]["psnr"] = {"na": DREAMSIM}
    latex = latex_tables(check_results(results, "example"))
    assert "n/a$^{(1)}$" in latex
    assert "(1) weights dreamsim are not here." in latex
    assert "persist weights" not in latex


def test_a_line_end_in_a_name_does_not_end_a_comment_of_latex():
    results = example_results()
    results["checkpoints"][0]["training_scenes"] = {"known": 1, "complete": True, "evaluated": ["a\n\\input{b}"]}
    latex = latex_tables(check_results(results, "example"))
    [line] = [line for line in latex.splitlines() if "\\input{b}" in line]
    assert line.startswith("% warning: ")


@pytest.mark.parametrize("own_seeds", [1, 3])
def test_the_caption_says_what_deviations_are_over(own_seeds):
    results = example_results()
    for row in results["tables"][0]["rows"].values():
        row["training_seeds"] = [[seed] for seed in range(own_seeds)]
    latex = latex_tables(check_results(results, "example"))
    assert ("over training seeds where a row has several" in latex) is (own_seeds > 1)


def test_tables_of_five_clips_have_no_interval_and_no_star_and_say_why():
    results = example_results(clips=5)  # with intervals, as earlier versions wrote them
    text, latex = table_text(results), latex_tables(check_results(results, "example"))
    for form in (text, latex):
        assert "5 clips: too few for an interval; give at least 6" in form
        assert "interval leaves zero out" not in form
    assert "| +2.00 |" in text
    assert "[" not in text
    assert "$^*$" not in latex
    assert "\\scriptsize" not in latex
    assert "[" in table_text(example_results(clips=6))


def test_a_row_that_cannot_be_made_leaves_no_column_out_and_makes_none_empty():
    results = example_results()
    row = results["tables"][0]["rows"]["voxel, shuffled"]
    row |= {"na": "needs two scenes", "columns": {name: {"na": "needs two scenes"} for name in row["columns"]}}
    text = table_text(results)
    assert re.search(r"\| voxel, shuffled<br>\(memory control\) \|( n/a \(1\) \|){5}", text)
    assert "- n/a (1): needs two scenes" in text
    assert "left out: DreamSim (weights are not here: persist weights fetch dreamsim)" in text


def test_markdown_tables_stay_whole_when_a_row_name_holds_markup():
    text = table_text(example_results(rows={"none": "model", HOSTILE: "control"}))
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert len({len(re.findall(r"(?<!\\)\|", line)) for line in rows}) == 1
    assert "<script>" not in text


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


def in_scenes(results, scenes):
    """The results as this version writes them, with figures of clips in so many scenes."""
    results["statistics"] = {"resampled": "scenes", "resamples": 1000}
    for clip, record in enumerate(results["measured"]["clips"]):
        record["scene"] = f"house-{clip % scenes}"
    for row in results["tables"][0]["rows"].values():
        for cell in row["columns"].values():
            cell |= {} if "na" in cell else {"units": scenes}
    return results


def test_intervals_over_scenes_say_so_and_too_few_scenes_are_counted():
    enough, few = (in_scenes(example_results(clips=18), scenes) for scenes in (6, 5))
    assert "[95 % interval, bootstrap over scenes]" in table_text(enough)
    assert "5 scenes: too few for an interval; give at least 6" in table_text(few)
    latex = latex_tables(check_results(enough, "example"))
    assert r"18 clips of 9 frames at 64$\times$64, 6 scenes" in latex
