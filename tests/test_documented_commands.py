"""Every command, program and file of README.md and docs/ runs as it stands there, only shorter and on smaller data.

Each page begins in a fresh folder and depends on nothing but itself. A block runs by its language: the lines of
``bash`` one by one, those of ``console`` too, whose shown output must come; ``python`` in one namespace a page;
``toml``, ``yaml`` and ``json`` are parsed. A block whose first line is a comment with a file's name is also written to
that file; a script of the shell is only parsed. ``text`` is what a program prints or draws and is not run, nor is
``bibtex``.
"""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
import yaml

from persist_cli.data.reference import sample_data
from persist_cli.errors import PluginError
from persist_cli.metrics.lpips import ALEX, tensor_shapes
from persist_cli.plugins import make_simulator
from persist_cli.train.log import StepLog
from tests.support.command_lines import parse_words
from tests.support.documented import Block, commands, read_blocks, run_here, shown_commands, shows
from tests.support.micro_runs import IN_FLOAT32, write_walks
from tests.support.predictions import cache_random
from tests.support.rooms import write_sequence
from tests.support.text_encoder import write_text_encoder
from tests.support.twins import write_twin

ROOT = Path(__file__).parents[1]

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), ROOT / "CONTRIBUTING.md"]

SLOW = {"tutorial"}  # pages that take longer than a minute

LANGUAGES = {"bash", "console", "python", "toml", "yaml", "json", "text", "bibtex"}

# what is put in the place of large numbers: an option or setting that is given again wins
SHORTER = {
    "finetune": (
        "training.steps=1", "training.batch=1", "training.accumulation=1", "training.workers=0", "training.warmup=1",
        "training.cooldown=0", "data.clip_frames=[]",  # the small model's codec folds time, and it has one length
        *IN_FLOAT32,
    ),
    "inspect": ("--pairs", "4"),
    "rollout": ("--steps", "1"),
    "plan": ("--candidates", "5", "--rounds", "1"),
    "eval": ("--clips", "1", "--seeds", "1", "--steps", "1"),
    "collect": ("--workers", "1"),
    "view": ("--export", "shortened.html"),  # or it would not end
    "learn": (
        "--steps", "1", "--guidance", "1", "--walks", "3", "--actions", "24", "--rounds", "1", "--training-steps", "1",
        "--proposals", "1",
        "--set", "training.batch=2", "--set", "training.workers=0",
    ),
}  # fmt: skip

# and what is put in the place of single words
REPLACED = {
    "--scenes 0:200": "--scenes 0:2",
    "--scenes 0:20": "--scenes 0:2",
    "--scenes 3000:3300 --frames 48": "--scenes 3000:3003 --frames 32",
    "--episodes runs/episodes.json --out runs/learn": "--patience 1 --episodes runs/episodes.json --out runs/learn",
    "--bins 8,16 --each 4": "--bins 8 --each 1",
    "--scenes 0:48 --each 16": "--scenes 0:2 --bins 8 --each 1",
    "right*6 forward right*6 forward*14": "right*6 forward*3",
    "--data DATA": "--data DATA backbone.settings.height=32 backbone.settings.width=32",  # as the walks in GIVEN
    "cogvideox-5b-i2v-stage1-lora --data": "cogvideox-5b-i2v-stage1-lora lora.rank=2 --data",
    "cogvideox-5b-i2v-stage2-voxel --data": "cogvideox-5b-i2v-stage2-voxel memory.encoder=patches "
    "memory.encoder_settings={} 'adapter={width: 16, heads: 2, token_budget: 32}' data.context_frames=4 --data",
    "bench collisions --scenes 0:12": "bench collisions --scenes 0:1 --walks 1 --actions 4 --steps 1",
    "house.safetensors --start sample#0": "house.safetensors",  # where nothing is exported; tests/viewer opens it
    "--dtype bfloat16 --save-memory model-offload,vae-tiling": "--save-memory vae-tiling",  # there is no accelerator
}

# commands that are not run, by how they begin, with the reason; those of persist are still parsed
NOT_RUN = {
    "make ": "a target of the Makefile, which the tests of demos, tables and benchmarks hold to",
    "python -m persist_cli.reproduce": "trains for hours, which tests/reproduce hold to",
    "git ": "changes the checkout that is tested",
    "cd persist": "see git",
    "sudo ": "needs a package manager",
    "apt ": "needs a package manager",
    "python3 -m venv": "the environment of the tests is there",
    "source ": "see python3 -m venv",
    "pip ": "the environment of the tests is not changed",
    "hf download": "needs the hub",
    "persist weights fetch": "downloads",
    "persist doctor": "takes half a minute for a published model; tests/doctor runs it on them",
    "persist bench plan": "walks through houses for minutes; tests/bench runs it small",
    "persist bench collisions": "walks through houses for minutes; tests/bench runs it small",
    "persist bench scene": "the nearest of many houses takes minutes; tests/bench runs it small",
    "persist play": "serves a page until Ctrl-C; tests/play walk there",
    "python tests/benchmarks": "measures for minutes; tests/benchmarks says what",
    "persist --install-completion": "changes the files of the shell",
    "sbatch ": "needs Slurm",
    "open ": "opens a window",
    "pytest": "would run the tests again",
    "ruff ": "is run by make lint",
}

# programs that are only compiled, by their first line, with the reason
SKETCHES = {
    "class LastFrame(Memory):  # from persist_cli.api.memory": "its imports are left out; docs/plugins.md runs all",
    "# needs stable-baselines3": "learns for long; tests/environments learn shortly",
    "# needs stable-baselines3, too": "see # needs stable-baselines3",
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, collecting_here, draw_loss) -> Path:
    """A fresh working folder of a user, with a capture, data and a pretrained model in diffusers' layout."""
    monkeypatch.setattr(StepLog, "draw", draw_loss)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PERSIST_REFERENCE", raising=False)  # pages use the packaged model
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("COLUMNS", "160")
    return tmp_path


def cache_lpips(cache: Path) -> None:
    """Cache random weights of LPIPS."""
    cache_random(cache, "lpips-alex", tensor_shapes(ALEX))


# what a page may take as given, by the word for it
GIVEN: dict[str, Callable[[Path], object]] = {
    "captures/kitchen": lambda path: write_sequence(path, 48, (48, 64)),  # twice around, so that clips return
    "DATA": write_walks,
    "runs/walks/walk-20260501-101500-3f2a/data": lambda path: shutil.copytree(sample_data(), path),  # what was recorded
    "DIR": lambda path: write_text_encoder(write_twin("5b-i2v", path)),
    "weights fetch lpips-alex\npersist": lambda path: cache_lpips(path.parent / "cache"),
}


def shortened(line: str) -> list[str]:
    """The words of a command line with small numbers in the place of large ones."""
    for long, short in REPLACED.items():
        line = line.replace(long, short)
    words = shlex.split(line)
    if words[:2] == ["accelerate", "launch"]:  # one process is enough to see that the command is right
        words = ["persist", *words[words.index("persist_cli") + 1 :]]
    extra = () if "--dry-run" in words or "--compare" in words else SHORTER.get(words[1] if words[1:] else "", ())
    frames = ("--frames", "8") if "--follow" in words else ()
    return [*words, *extra, *frames]


def is_not_run(line: str) -> bool:
    """Whether a command is among those that are not run; one of persist is parsed."""
    if not line.startswith(tuple(NOT_RUN)):
        return False
    if line.startswith("persist ") and "--install-completion" not in line:
        parse_words(shlex.split(line)[1:])
    return True


def run_line(line: str) -> tuple[int, str]:
    """Run one command; its exit code and what it printed."""
    words = shortened(line)
    assert words[0] == "persist", f"{line}: not a command of persist; run it, or name it in NOT_RUN with the reason"
    return run_here(words[1:])


def run_bash(block: Block, where: str) -> None:
    """Run the commands of a block, each of which must succeed."""
    for line in commands(block):
        if not is_not_run(line):
            code, printed = run_line(line)
            assert code == 0, f"{where}: {line}\n{printed}"


def run_console(block: Block, where: str) -> None:
    """Run the commands of a block, which must print what is shown below them, be it an error."""
    for shown in shown_commands(block):
        code, printed = run_line(shown.command)
        assert code in (0, 1, 2), f"{where}: {shown.command}\n{printed}"
        for line in shown.lines:
            assert shows(printed, line), f"{where}: {shown.command} does not print\n{line}\nbut\n{printed}"


def run_block(block: Block, page: Path, names: dict[str, object]) -> None:
    """Run, parse or only write a block of a page."""
    where = f"{page.name}:{block.line}"
    assert block.language in LANGUAGES, f"{where}: a block of {block.language or 'no language'}"
    if block.file is not None:
        Path(block.file).parent.mkdir(parents=True, exist_ok=True)
        Path(block.file).write_text(block.text, encoding="utf-8")
        if block.file.endswith(".sh"):
            subprocess.run(["bash", "-n", block.file], check=True)
            return
    match block.language:
        case "bash":
            run_bash(block, where)
        case "console":
            run_console(block, where)
        case "python":
            program = compile("\n" * (block.line - 1) + block.text, str(page), "exec")
            if block.text.partition("\n")[0] not in SKETCHES:
                exec(program, names)
        case "toml":
            tomllib.loads(block.text)
        case "yaml":
            yaml.safe_load(block.text)
        case "json":
            json.loads(block.text)


def needs_simulator(blocks: list[Block]) -> bool:
    return any("persist collect miniworld" in block.text for block in blocks if block.language in ("bash", "console"))


@pytest.mark.parametrize(
    "page", [pytest.param(page, marks=[pytest.mark.slow] * (page.stem in SLOW), id=page.stem) for page in PAGES]
)
def test_every_block_of_a_page_runs_in_order_from_a_fresh_folder(page, folder, monkeypatch):
    blocks = read_blocks(page)
    if needs_simulator(blocks):
        try:
            make_simulator("miniworld", {})
        except PluginError as error:
            pytest.skip(str(error))
    for word, give in GIVEN.items():
        if any(word in block.text for block in blocks if block.language in ("bash", "console", "python")):
            give(folder / word)
    module = ModuleType(f"documented_{page.stem}".replace("-", "_"))  # dataclasses look for the module of their class
    monkeypatch.setitem(sys.modules, module.__name__, module)
    for block in blocks:
        run_block(block, page, vars(module))


def test_each_replacement_and_each_exception_is_of_use():
    text = "\n".join(block.text.replace("\\\n", " ") for page in PAGES for block in read_blocks(page))
    text = " ".join(text.split())
    unused = [entry for entry in (*REPLACED, *NOT_RUN, *SKETCHES, *GIVEN) if " ".join(entry.split()) not in text]
    assert not unused
