"""Every command works in an installation without extras, or says which one it needs."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from tests.support.micro_runs import MICRO_SETTINGS, stage

EXTRAS = (
    "peft", "miniworld", "gymnasium", "pyglet", "bitsandbytes", "deepspeed", "tensorboard", "sentencepiece", "skimage",
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


@pytest.fixture
def without_extras(tmp_path):
    """Runs commands in one process without extras and without a terminal; gives what each printed."""

    def run(*commands: list[object]) -> list[str]:
        texts = json.dumps([[str(argument) for argument in command] for command in commands])
        log = tmp_path / "log"
        with log.open("w") as file:
            command = [sys.executable, "-c", COMMANDS, json.dumps(EXTRAS), texts]
            subprocess.run(
                command, stdout=file, stderr=file, stdin=subprocess.DEVNULL, env=os.environ | {"COLUMNS": "80"}
            )
        printed = log.read_text().split("$ ")[1:]
        assert len(printed) == len(commands), log.read_text()
        return printed

    return run


def test_every_command_works_without_extras(without_extras, walks, held_out, stage1, voxel, tmp_path):
    few = ["--metrics", "psnr", "--controls", "copy", "--seeds", 1, "--clips", 1, "--steps", 1, "--memories", "voxel"]
    printed = without_extras(
        ["recipes"], ["recipes", "tiny-stage1"], ["plugins"], ["weights", "list"], ["inspect", walks],
        ["doctor", "tiny-stage1", *MICRO_SETTINGS, "base=null", "--gpu-memory", 80],
        [*stage("stage1", walks, tmp_path / "run", f"base={stage1}", "training.steps=1")],
        ["memorize", f"{walks}#0:0-5", "--out", tmp_path / "m.safetensors"],
        ["rollout", voxel, "--start", f"{walks}#0:4", "--actions", "left", "--steps", 1, "--out", tmp_path / "rollout"],
        ["eval", voxel, "--data", held_out, *few, "--out", tmp_path / "eval", "--report", tmp_path / "report"],
        ["export", stage1, voxel, "--out", tmp_path / "export"],
    )  # fmt: skip
    for text in printed:
        assert text.rstrip().endswith("ended with 0")
        assert "Traceback" not in text
    assert "not considered: LoRA (lora needs the package peft: pip install 'persist-cli[lora]')" in printed[5]
    assert "pip install 'persist-cli[miniworld]'" in " ".join(printed[2].replace("│", " ").split())


def test_a_command_that_needs_an_extra_says_how_to_install_it(without_extras, walks, stage1, tmp_path):
    changes = {
        "lora": "lora.rank=2", "bitsandbytes": "training.optimizer=adamw-8bit",
        "tensorboard": "training.tracker=tensorboard",
    }  # fmt: skip
    finetunes = [stage("stage1", walks, tmp_path / extra, f"base={stage1}", changes[extra]) for extra in changes]
    collect = ["collect", "miniworld", "--scenes", "0:1", "--out", tmp_path / "houses"]
    printed = without_extras(*finetunes, collect)
    for extra, text in zip([*changes, "miniworld"], printed, strict=True):
        assert text.rstrip().endswith("ended with 1")
        assert f"pip install 'persist-cli[{extra}]'" in text
        assert text.count("\n") == 3  # the command, the error, the exit code
    assert "apt-get install libegl1" in printed[-1]
