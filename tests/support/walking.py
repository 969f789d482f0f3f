"""Walks through the furnished room by named actions, and the smallest model that takes their images."""

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

from persist_cli.api.actions import walking_actions
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
    "vae": {"block_out_channels": [8, 8, 8], "norm_num_groups": 4, "latent_channels": 4},
}  # fmt: skip

MICRO_SETTINGS = [
    f"backbone.settings.height={SIZE}",
    f"backbone.settings.width={SIZE}",
    "backbone.settings.transformer={num_layers: 2, num_attention_heads: 2, attention_head_dim: 32, in_channels: 8, "
    "out_channels: 4, time_embed_dim: 32, text_embed_dim: 8}",
    "backbone.settings.vae={block_out_channels: [8, 8, 8], norm_num_groups: 4, latent_channels: 4}",
    "backbone.settings.codec_window=null",
]

SHORT = ["training.steps=4", "training.batch=2", "training.workers=0", "training.warmup=2"]

OUT = ("left", "left", "forward", "left", "left", "forward", "left", "left", "left", "forward", "left")

PERSIST = [sys.executable, "-m", "persist_cli"]


def stage(number: str, data: Path, out: Path, *changes: str) -> list[str]:
    """Arguments of a short finetune run of the micro model."""
    return ["finetune", f"tiny-{number}", "--data", str(data), "--out", str(out), *SHORT, *changes]


def train(*arguments: str) -> None:
    """Run ``persist`` in a process of its own."""
    subprocess.run([*PERSIST, *arguments], check=True, capture_output=True)


def train_here(*arguments: str) -> None:
    """Run ``persist`` in this process."""
    said = io.StringIO()
    with contextlib.redirect_stderr(said), pytest.raises(SystemExit) as ended:
        main(list(arguments))
    assert not ended.value.code, said.getvalue()


def launched(module: str, *arguments: str, kind: Sequence[str] = ("--multi_gpu",)) -> dict[str, Any]:
    """How to start a module as two processes with gloo; ``--multi_gpu`` is accelerate's word for several."""
    launch = [
        *kind,
        "--num_machines",
        "1",
        "--num_processes",
        "2",
        "--mixed_precision",
        "no",
        "--main_process_port",
        "0",
    ]
    command = [sys.executable, "-m", "accelerate.commands.launch", *launch, "--dynamo_backend", "no", "--module"]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "ACCELERATE_USE_CPU": "true"}
    return {"args": [*command, module, *arguments], "env": environment}


def in_two(*arguments: str, kind: Sequence[str] = ("--multi_gpu",)) -> dict[str, Any]:
    """How to start ``persist`` as two processes."""
    return launched("persist_cli", *arguments, kind=kind)


def together(*arguments: str) -> None:
    """Run ``persist`` as two processes."""
    subprocess.run(**in_two(*arguments), check=True, capture_output=True)


def end_of(run: Path) -> tuple[dict[str, torch.Tensor], str]:
    """All that a run came to: its newest training state and its log."""
    return read_tensors(max(run.glob("step-*")) / "training.safetensors")[0], (run / "log.jsonl").read_text()


def first_gradients(state: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """All gradients of a run's first step, of the training state after it."""
    moments = [each.flatten() for name, each in state.items() if "exp_avg/" in name]
    return torch.cat(moments) / 0.1  # AdamW's first moments begin with so much of them


def losses(run: Path) -> list[float]:
    """The loss of each step that a run logged."""
    return [json.loads(line)["loss"] for line in (run / "log.jsonl").read_text().splitlines()]


def ended_alike(one: Path, two: Path) -> bool:
    """Whether two runs came to the same, to the bit."""
    (weights, log), (others, other_log) = end_of(one), end_of(two)
    same = weights.keys() == others.keys() and all(torch.equal(weights[name], others[name]) for name in weights)
    return same and log == other_log


def write_walks(folder: Path, size: int = SIZE) -> Path:
    """Two trajectories, out and back by the reversed actions, in rooms of two names."""
    room, vocabulary = Room(size, size), walking_actions(0.2, 15.0)
    out = list(OUT)
    for number, start in enumerate((look((0.0, 1.3, 0.2), 0.0, 0.0), look((0.3, 1.3, -0.2), 90.0, 0.0))):
        actions = [*out, "pick_up", *vocabulary.reversed(out)]
        poses = [start, *vocabulary.follow(torch.from_numpy(start), actions, torch.tensor(UP).double()).numpy()]
        names = [*actions, None]
        frames: list[Frame] = [
            room.see(pose, name, float(i)) for i, (pose, name) in enumerate(zip(poses, names, strict=True))
        ]
        info = replace(room.info, scene=f"room-{number}", vocabulary=vocabulary)
        write_trajectory(folder / f"walk-{number}.parquet", info, frames)
    return folder


def without_depth(walks: Path, folder: Path) -> Path:
    """The same walks seen by a camera that gives no depth."""
    for file in Store(walks):
        whole = file.read()
        steps = zip(whole.observations.rgb, whole.observations.cameras.world_from_camera, whole.actions, strict=True)
        nothing = np.zeros((SIZE, SIZE), np.float32)
        frames = [Frame(rgb.numpy(), nothing, pose.numpy(), name) for rgb, pose, name in steps]
        write_trajectory(folder / file.path.name, file.info, frames)
    return folder


def smoothed(frames: int) -> np.ndarray:
    """Poses of a slow turn to the left that never turns back."""
    return np.stack([look((0.0, 1.3, 0.0), 6.0 * number, 0.0) for number in range(frames)])
