"""What machines read of the console and of files."""

import json
import math

import pytest

from persist_cli.viewing.console import print_json
from persist_cli.world.files import write_json

FIGURES = {"psnr": [20.0, math.nan], "rmse": (math.inf, {"low": -math.inf})}
PLAIN = {"psnr": [20.0, None], "rmse": [None, {"low": None}]}


def test_json_has_null_where_a_figure_is_not_defined(tmp_path, capsys):
    write_json(tmp_path / "a.json", FIGURES)
    print_json(FIGURES)
    for text in ((tmp_path / "a.json").read_text(), capsys.readouterr().out):
        assert json.loads(text, parse_constant=pytest.fail) == PLAIN
