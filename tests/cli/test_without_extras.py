"""Every command works in an installation without extras, or says which one it needs."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.micro_runs import MICRO_SETTINGS, stage

EXTRAS = (
    "peft", "miniworld", "gymnasium", "pyglet", "bitsandbytes", "deepspeed", "tensorboard", "sentencepiece", "skimage",
    "viser",
)  # fmt: skip

# packages that are None cannot be imported or found
COMMANDS = """
import json, sys
sys.modules.update(dict.fromkeys(json.loads(sys.argv[1])))
from persist_cli.cli.app import main
for arguments in json.loads(sys.argv[2]):
    print("$", *arguments, flush=True)
    try:
        main(arguments)
    except SystemExit as ended:
        print("ended with", ended.code or 0, flush=True)
"""


# savings in force already, so that the doctor estimates few others
SAVING = ["training.batch=1", "training.vae_slicing=true", "training.gradient_checkpointing=true"]

NEEDED = {
    "lora": "lora.rank=2", "bitsandbytes": "training.optimizer=adamw-8bit",
    "tensorboard": "training.tracker=tensorboard",
}  # fmt: skip


def print_without_extras(log: Path, commands: list[list[object]]) -> list[str]:
    """Run commands in one process without extras and without a terminal; what each printed."""
    texts = json.dumps([[str(argument) for argument in command] for command in commands])
    with log.open("w") as file:
        command = [sys.executable, "-c", COMMANDS, json.dumps(EXTRAS), texts]
        environment = os.environ | {"COLUMNS": "80"}
        subprocess.run(command, stdout=file, stderr=file, stdin=subprocess.DEVNULL, env=environment)
    printed = log.read_text().split("$ ")[1:]
    assert len(printed) == len(commands), log.read_text()
    return printed


@pytest.fixture(scope="module")
def printed(walks, held_out, stage1, voxel, tmp_path_factory) -> list[str]:
    """What each command printed that needs no extra, then what those printed that need one."""
    out = tmp_path_factory.mktemp("without")
    own = out / "own.yaml"  # whose name has no stage 2 that the doctor would compare it with
    own.write_text("extends: tiny-stage1\n")
    few = ["--metrics", "psnr", "--controls", "copy", "--seeds", 1, "--clips", 1, "--steps", 1, "--memories", "voxel"]
    commands = [
        ["recipes"], ["recipes", "tiny-stage1"], ["plugins"], ["weights", "list"], ["inspect", walks, "--pairs", 8],
        ["doctor", own, *MICRO_SETTINGS, *SAVING, "base=null", "--gpu-memory", 80],
        [*stage("stage1", walks, out / "run", f"base={stage1}", "training.steps=1")],
        ["memorize", f"{walks}#0:0-5", "--out", out / "m.safetensors"],
        ["rollout", voxel, "--start", f"{walks}#0:4", "--actions", "left", "--steps", 1, "--out", out / "rollout"],
        ["eval", voxel, "--data", held_out, *few, "--out", out / "eval", "--report", out / "report"],
        ["export", stage1, voxel, "--out", out / "export"],
    ]  # fmt: skip
    commands += [stage("stage1", walks, out / name, f"base={stage1}", change) for name, change in NEEDED.items()]
    commands += [["view", f"{walks}#0"], ["collect", "miniworld", "--scenes", "0:1", "--out", out / "houses"]]
    return print_without_extras(out / "log", commands)


def test_every_command_works_without_extras(printed):
    for text in printed[:11]:
        assert text.rstrip().endswith("ended with 0")
        assert "Traceback" not in text
    assert "not considered: LoRA (lora needs the package peft: pip install 'persist-cli[lora]')" in printed[5]
    assert "pip install 'persist-cli[miniworld]'" in " ".join(printed[2].replace("│", " ").split())


def test_a_command_that_needs_an_extra_says_how_to_install_it(printed):
    for extra, text in zip([*NEEDED, "view", "miniworld"], printed[11:], strict=True):
        assert text.rstrip().endswith("ended with 1")
        assert f"pip install 'persist-cli[{extra}]'" in text
        assert text.count("\n") == 3  # the command, the error, the exit code
    assert "apt-get install libegl1" in printed[-1]
