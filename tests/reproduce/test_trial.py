"""A trial runs the commands of a whole chain in their smallest form, apart from the chain's own results."""

from __future__ import annotations

import shlex
from pathlib import Path
from types import ModuleType

import pytest

from persist_cli.cli.app import commands
from persist_cli.cli.bench import refuse_other_parts
from persist_cli.recipe import apply_overrides, make_recipe, read_recipe
from persist_cli.reproduce import scenes, table1
from persist_cli.reproduce.trial import small, trial_folder
from tests.support.command_lines import parse_line

OUT = trial_folder(Path("my runs/all"))

LINES = [*scenes.commands(scenes.SceneFigures(OUT)), *table1.commands(OUT), *table1.reference_commands(OUT)]


LIMITS = {
    "eval": {"clips": 2, "seeds": 1, "steps": 1}, "bench": {"images": 2},
    "walk": {"walks": 1, "walk_steps": 8, "seeds": 1}, "return": {"walks": 1, "return_steps": 8, "seeds": 1},
    "completion": {"seeds": 1, "houses": 2}, "edits": {"edits": 2}, "evolution": {"interactions": 2, "seeds": 1},
}  # fmt: skip


def limits(line: str) -> dict[str, int]:
    """The most that a command of a trial may be asked for, by parameter."""
    parts = str(parse_line(line).get("parts", "")).split(",")
    return {name: most for part in [line.split()[0], *parts] for name, most in LIMITS.get(part, {}).items()}


@pytest.mark.parametrize("line", LINES)
def test_every_command_is_small(line: str) -> None:
    words, command = parse_line(small(line)), line.split()[0]
    assert all(words[name] <= most for name, most in limits(line).items())
    if command == "collect":
        low, high = map(int, words["scenes"].split(":"))
        assert high == low + 2
        assert low == int(parse_line(line)["scenes"].split(":")[0])
    elif command == "finetune" and "choices" not in words["recipe"]:  # those recipes are made by the chain itself
        training = make_recipe(apply_overrides(read_recipe(words["recipe"]), words["overrides"]), line).training
        assert (training.steps, training.batch, training.cooldown) == (2, 2, 0)


@pytest.mark.parametrize("line", [line for line in LINES if line.startswith("bench scene")])
def test_parts_get_the_options_that_they_have_a_use_for(line: str) -> None:
    command = commands()
    for word in ("bench", "scene"):
        command = command.commands[word]
    context = command.make_context("persist", shlex.split(small(line))[2:])
    refuse_other_parts(context, context.params["parts"].split(","))


@pytest.mark.parametrize("line", LINES)
def test_all_else_stays_as_in_the_chain(line: str) -> None:
    long, short = parse_line(line), parse_line(small(line))
    changed = {name for name in long if long[name] != short[name]}
    assert changed <= {"scenes", "seeds", "overrides", *limits(line)}


@pytest.mark.parametrize("chain", [scenes, table1])
def test_nothing_of_a_trial_lies_among_results(
    chain: ModuleType, voxel: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    ran: list[str] = []
    monkeypatch.setattr(chain, "run_small", ran.append)
    monkeypatch.setattr(chain, "run_line", lambda line: pytest.fail(f"not small: {line}"))
    monkeypatch.setattr("persist_cli.reproduce.scene_agents.main", lambda arguments: ran.append(" ".join(arguments)))
    chain.main([str(tmp_path), "--trial", *(["--reference"] if chain is table1 else ["--checkpoint", str(voxel)])])
    assert len(ran) > 5
    written = [line for line in ran if str(tmp_path) in line]
    assert written
    assert all(f"{tmp_path}/" not in line.replace(f"{tmp_path}/trial", "") for line in written)
