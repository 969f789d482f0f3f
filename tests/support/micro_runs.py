"""Runs of the smallest model on walks through a furnished room by named actions: how to start and compare them."""

from __future__ import annotations

import contextlib
import io
import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from persist_cli.api.actions import ActionVocabulary, walking_actions
from persist_cli.api.half_precision import is_slow
from persist_cli.api.observations import Frame
from persist_cli.cli.app import main
from persist_cli.data.store import Store, write_trajectory
from persist_cli.io.files import read_tensors
from tests.support.rooms import UP, Room, look

SIZE = 32

MICRO = {
    "height": SIZE,
    "width": SIZE,
    "transformer": {
        "num_layers": 2, "num_attention_heads": 2, "attention_head_dim": 32, "in_channels": 8, "out_channels": 4,
        "time_embed_dim": 32, "text_embed_dim": 8,
    },
    "vae": {"block_out_channels": [8, 8, 8], "layers_per_block": 1, "norm_num_groups": 4, "latent_channels": 4},
}  # fmt: skip

MICRO_SETTINGS = [
    f"backbone.settings.{name}={json.dumps(value)}" for name, value in {**MICRO, "codec_window": None}.items()
]

SHORT = ["training.steps=4", "training.batch=2", "training.workers=0", "training.warmup=2"]

# steps in half precision take 50 times as long on processors without instructions for it
IN_FLOAT32 = ("training.precision=no", "training.frozen_precision=no") if is_slow(torch.bfloat16) else ()

OUT = ("left", "left", "forward", "left", "left", "forward", "left", "left", "left", "forward", "left")

BACK = (  # another way back than that of OUT: no pose is within 0.2 m and 10° of one of the way out
    *("backward", "backward", "right", "right", "right", "right"),
    *("right", "backward", "right", "backward", "right", "right"),
)

PERSIST = [sys.executable, "-m", "persist_cli"]


def stage(number: str, data: Path, out: Path, *changes: str) -> list[str]:
    """Arguments of a short finetune run of the micro model."""
    return ["finetune", f"tiny-{number}", "--data", str(data), "--out", str(out), *SHORT, *changes]


def run_persist_process(*arguments: str) -> None:
    """Run ``persist`` in a process of its own."""
    subprocess.run([*PERSIST, *arguments], check=True, capture_output=True)


def run_persist(*arguments: str) -> None:
    """Run ``persist`` in this process."""
    stderr = io.StringIO()
    with contextlib.redirect_stderr(stderr), pytest.raises(SystemExit) as ended:
        main(list(arguments))
    assert not ended.value.code, stderr.getvalue()


def two_process_launch(module: str, *arguments: str, kind: Sequence[str] = ("--multi_gpu",)) -> dict[str, Any]:
    """Arguments of ``subprocess`` that start a module as two processes with gloo.

    Args:
        module: name of the module.
        arguments: arguments of the module.
        kind: options of the launcher; ``--multi_gpu`` is accelerate's word for several processes, here on the CPU.
    """
    launch = [
        *kind, "--num_machines", "1", "--num_processes", "2", "--mixed_precision", "no", "--main_process_port", "0",
        "--dynamo_backend", "no",
    ]  # fmt: skip
    command = [sys.executable, "-m", "accelerate.commands.launch", *launch, "--module"]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "ACCELERATE_USE_CPU": "true"}
    return {"args": [*command, module, *arguments], "env": environment}


def run_result(run: Path) -> tuple[dict[str, torch.Tensor], str]:
    """The newest training state of a run, and its log."""
    return read_tensors(max(run.glob("step-*")) / "training.safetensors")[0], (run / "log.jsonl").read_text()


def first_gradients(state: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """All gradients of a run's first step, from the training state after it."""
    moments = [tensor.flatten() for name, tensor in state.items() if "exp_avg/" in name]
    return torch.cat(moments) / 0.1  # AdamW's first moments begin with so much of them


def losses(run: Path) -> list[float]:
    """The loss of each step that a run logged."""
    return [json.loads(line)["loss"] for line in (run / "log.jsonl").read_text().splitlines()]


def equal_runs(first: Path, second: Path) -> bool:
    """Whether the training states and logs of two runs are equal to the bit."""
    (state, log), (second_state, second_log) = run_result(first), run_result(second)
    if state.keys() != second_state.keys() or log != second_log:
        return False
    return all(torch.equal(tensor, second_state[name]) for name, tensor in state.items())


def write_walks(folder: Path, size: int = SIZE) -> Path:
    """Write two trajectories, out and back by the reversed actions, in scenes of two names."""
    vocabulary = walking_actions(0.2, 15.0)
    return _write_two(folder, size, vocabulary, [*OUT, "pick_up", *vocabulary.reversed(list(OUT))], ("walk", "room"))


def write_loops(folder: Path, size: int = SIZE) -> Path:
    """Write two trajectories, out and back by another way, in scenes of two other names."""
    return _write_two(folder, size, walking_actions(0.25, 15.0), [*OUT, *BACK], ("loop", "held-out"))


def _write_two(
    folder: Path, size: int, vocabulary: ActionVocabulary, actions: Sequence[str], names: tuple[str, str]
) -> Path:
    """Write the walk from two starts; ``names`` are those of trajectories and scenes, before their numbers."""
    room = Room(size, size)
    for number, start in enumerate((look((0.0, 1.3, 0.2), 0.0, 0.0), look((0.3, 1.3, -0.2), 90.0, 0.0))):
        poses = [start, *vocabulary.follow(torch.from_numpy(start), actions, torch.tensor(UP).double()).numpy()]
        steps = enumerate(zip(poses, [*actions, None], strict=True))
        info = replace(room.info, scene=f"{names[1]}-{number}", vocabulary=vocabulary)
        write_trajectory(
            folder / f"{names[0]}-{number}.parquet", info, [room.see(pose, name, float(i)) for i, (pose, name) in steps]
        )
    return folder


def without_depth(walks: Path, folder: Path) -> Path:
    """Write the walks as a camera without depth sees them."""
    for file in Store(walks):
        walk = file.read()
        steps = zip(walk.observations.rgb, walk.observations.cameras.world_from_camera, walk.actions, strict=True)
        depth = np.zeros((SIZE, SIZE), np.float32)
        frames = [Frame(rgb.numpy(), depth, pose.numpy(), name) for rgb, pose, name in steps]
        write_trajectory(folder / file.path.name, file.info, frames)
    return folder


def slow_turn(frames: int) -> np.ndarray:
    """Poses of a turn to the left by six degrees a frame that never turns back."""
    return np.stack([look((0.0, 1.3, 0.0), 6.0 * number, 0.0) for number in range(frames)])
