"""The console prints JSON that machines can read, and tables that cut no word."""

import json
import math

import pytest
from rich.console import Console

from persist_cli.io.files import write_json
from persist_cli.viewing import console
from persist_cli.viewing.console import print_json, print_table

FIGURES = {"psnr": [20.0, math.nan], "rmse": (math.inf, {"low": -math.inf})}
PLAIN = {"psnr": [20.0, None], "rmse": [None, {"low": None}]}


def test_json_has_null_where_a_figure_is_not_defined(tmp_path, capsys):
    write_json(tmp_path / "a.json", FIGURES)
    print_json(FIGURES)
    for text in ((tmp_path / "a.json").read_text(), capsys.readouterr().out):
        assert json.loads(text, parse_constant=pytest.fail) == PLAIN


@pytest.mark.parametrize("width", [60, 80, 100, 160])
def test_a_table_cuts_no_number_or_name_in_a_terminal_of_any_width(width, capsys, monkeypatch):
    monkeypatch.setattr(console, "OUT", Console(width=width))
    columns = ["strategy", *(f"column {number}" for number in range(9)), "what it is"]
    rows = [["gradient checkpointing", *(f"{number}570479680" for number in range(9)), "some words that may wrap"]]
    print_table("title", columns, rows)
    printed = capsys.readouterr().out
    assert max(map(len, printed.splitlines())) <= width
    assert all(f" {cell} " in printed for cell in rows[0][:-1])
    assert all(word in printed for word in rows[0][-1].split())


def test_columns_that_fit_the_terminal_stand_in_one_table(capsys):
    print_table("title", ["a", "b", "c"], [["x", "1", "2"]])
    assert [line.split() for line in capsys.readouterr().out.splitlines() if "x" in line] == [list("│x│1│2│")]
