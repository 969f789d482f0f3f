"""The figures of plans are made by commands that persist has."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from persist_cli.episodes.rows import RowChoice
from persist_cli.errors import PersistError
from persist_cli.reproduce.plan_file import keep_plan
from persist_cli.reproduce.planning import PlanningFigures, commands, identity
from tests.support.command_lines import parse_line

OUT = Path("my runs/planning")


@pytest.mark.parametrize("line", commands(PlanningFigures(OUT)))
def test_every_command_is_one_that_persist_takes(line: str) -> None:
    parse_line(line)


def test_every_row_of_the_figures_can_be_made() -> None:
    for line in commands(PlanningFigures(OUT, policy="straight")):
        rows = re.search(r"--rows (\S+) --memories (\S+)", line)
        if rows:
            names, memories = (text.split(",") for text in rows.groups())
            assert RowChoice(names, memories, "straight", "image", 60).rows()


def test_a_folder_of_other_houses_is_refused(voxel: Path, tmp_path: Path) -> None:
    figures = PlanningFigures(tmp_path, str(voxel))
    for _ in range(2):
        keep_plan(tmp_path, identity(figures), "*.json")
    with pytest.raises(PersistError, match=r"another plan \(scenes: 40:96, now 0:4\)"):
        keep_plan(tmp_path, identity(replace(figures, scenes="0:4")), "*.json")


def test_episodes_that_are_drawn_are_not_drawn_again(tmp_path: Path) -> None:
    figures = PlanningFigures(tmp_path)
    assert sum(line.startswith("bench episodes") for line in commands(figures)) == 3
    (tmp_path / "episodes.json").touch()
    assert next(line for line in commands(figures) if line.startswith("bench episodes")).endswith("hidden.json")
    for name in ("hidden", "gap"):
        (tmp_path / f"{name}.json").touch()
    assert not any(line.startswith("bench episodes") for line in commands(figures))
