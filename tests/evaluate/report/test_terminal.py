"""The one table on the terminal."""

from __future__ import annotations

import copy
from io import StringIO

import pytest
from rich.console import Console

from persist_cli.evaluate.report import terminal
from persist_cli.evaluate.report.result_file import check_results
from persist_cli.evaluate.report.terminal import print_results, terminal_table
from tests.support.example_results import example_results


def heads(width, results=None):
    """The headings in a terminal of that width."""
    return terminal_table(check_results(results or example_results(), "example"), width).texts[0]


def printed(monkeypatch, results, width=80):
    """What a terminal of that width shows."""
    console = Console(file=StringIO(), width=width)
    monkeypatch.setattr("persist_cli.output.console.OUT", console)
    monkeypatch.setattr(terminal, "OUT", console)
    print_results(results)
    return console.file.getvalue()


@pytest.mark.parametrize("width", [50, 80, 120, 160])
def test_the_results_are_one_table_no_wider_than_the_terminal(width, monkeypatch):
    text = printed(monkeypatch, example_results(), width)
    assert text.count("┏") == 1
    assert max(len(line) for line in text.splitlines() if line.startswith(("│", "┃"))) <= width
    assert "PSNR ↑" in text


def test_a_wider_terminal_shows_differences_then_deviations_then_further_columns():
    assert heads(50) == ["row", "PSNR ↑", "LPIPS ↓"]
    assert heads(70) == ["row", "PSNR ↑", "Δ", "LPIPS ↓", "Δ"]
    assert heads(160) == ["row", "PSNR ↑", "Δ", "LPIPS ↓", "Δ", "SSIM ↑", "PSNR last ↑", "SRC ↑"]
    assert not terminal_table(check_results(example_results(), "example"), 70).deviations
    assert terminal_table(check_results(example_results(), "example"), 80).texts[1][1] == "20.05 ± 0.08"


def test_the_protocol_decides_which_columns_come_first():
    results = example_results()
    results["measured"]["protocol"]["name"] = "return"
    assert heads(80, results)[:3] == ["row", "SRC ↑", "Δ"]


def test_the_terminal_says_what_was_measured_and_what_is_left_out(monkeypatch):
    text = printed(monkeypatch, example_results(), 200)
    assert "Revisit: 6 clips of 9 frames in 3 scenes, 64×64, 3 seeds, 50 steps of ddim" in text
    assert "mean ± deviation over seeds" in text

    assert "Δ: paired difference to none; * its 95 % interval (bootstrap over clips) leaves zero out" in text
    assert "left out: DreamSim (weights are not here: persist weights fetch dreamsim)" in text
    assert "what voxel is" not in text  # definitions are in the files


def test_five_clips_get_no_star_on_the_terminal(monkeypatch):
    text = printed(monkeypatch, example_results(clips=5))
    assert "5 clips: too few for an interval; give at least 6" in text
    assert "*" not in text
    assert "*" in printed(monkeypatch, example_results(clips=6))


def test_the_tables_of_several_domains_are_one_table_under_their_names(monkeypatch):
    results = example_results()
    results["tables"].append(copy.deepcopy(results["tables"][0]) | {"name": "vizdoom", "clips": [0, 1, 2]})
    for row in results["tables"][1]["rows"].values():
        for cell in row["columns"].values():
            cell |= {"count": 3, "per_clip": None}
    text = printed(monkeypatch, results)
    assert text.count("┏") == 1
    assert "│ vizdoom: 3 clips" in text
    assert "3 clips: too few for an interval" in text


def test_a_column_that_one_table_alone_leaves_out_is_named_with_that_table(monkeypatch):
    results = example_results()
    results["tables"].append(copy.deepcopy(results["tables"][0]) | {"name": "vizdoom"})
    for row in results["tables"][1]["rows"].values():
        row["columns"]["ssim"] = {"na": "too small"}
    assert "left out: SSIM of vizdoom (too small)" in printed(monkeypatch, results, 160)


@pytest.mark.parametrize("length", [35, 70])
def test_a_long_row_name_goes_on_in_the_next_line_of_one_table(monkeypatch, length):
    name = f"voxel ({'runs/' * length}"[:length]
    text = printed(monkeypatch, example_results(rows={"none": "model", name: "model"}))
    assert text.count("┏") == 1
    assert max(len(line) for line in text.splitlines() if line.startswith("│")) <= 80


def test_a_row_name_that_looks_like_markup_is_printed_literally(monkeypatch):
    results = example_results(rows={"none": "model", "[bold]x[/red]": "control"})
    assert "[bold]x[/red]" in printed(monkeypatch, results, 160)
