"""``persist rollout``: from a start frame along actions, to videos, maps, poses and a memory."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import torch

from persist_cli.checkpoints import Checkpoint, find_checkpoint, load_adapter, load_backbone
from persist_cli.memorizing.memory_file import load_memory
from persist_cli.memorizing.recall import MemoryMaker
from persist_cli.packaged import reference_checkpoint
from persist_cli.rollout.outputs import write_outputs
from persist_cli.rollout.walk import Rollout, RolloutPlan, Walk, plan_walk
from persist_cli.rollout.world_model import WorldModel
from persist_cli.sampling import AskedSampling, sampling_of
from persist_cli.trajectories.clips import check_size
from persist_cli.viewing.console import add_task, print_json, progress, say
from persist_cli.world.errors import CheckpointError, PersistError
from persist_cli.world.memory import Memory
from persist_cli.world.observations import Observations, TrajectoryInfo


def run_rollout(path: Path | None, plan: RolloutPlan, out: Path, json: bool) -> None:
    """Roll out a checkpoint, or else the reference model, and leave a folder; see ``persist rollout --help``."""
    if (plan.actions is None) == (not plan.follow):
        raise PersistError("give either --actions TEXT or --follow")
    checkpoint = find_checkpoint(path or reference_checkpoint())
    adapter = plan.adapter or checkpoint.default_adapter()
    walk = plan_walk(plan)
    backbone = load_backbone(checkpoint)
    check_size(walk.info, backbone.image_size, plan.start)
    sampling = sampling_of(checkpoint, plan.sampling)
    backbone.check_sampling(sampling)
    plan = dataclasses.replace(plan, sampling=AskedSampling(**dataclasses.asdict(sampling)))
    load_adapter(backbone, checkpoint, adapter)
    backbone.to("cuda" if torch.cuda.is_available() else "cpu").eval()
    model = WorldModel(backbone, open_memory(checkpoint, adapter, plan, walk.info), sampling, plan.seed, plan.write)
    rollout = roll(model, walk)
    figures = write_outputs(rollout, out, describe(checkpoint, adapter, plan, rollout))
    if json:
        print_json(figures)
    else:
        say(f"{len(rollout.seen)} frames in {rollout.seconds:.1f} s along {walk.actions!r}; written to {out}")


def open_memory(checkpoint: Checkpoint, adapter: str | None, plan: RolloutPlan, info: TrajectoryInfo) -> Memory | None:
    """The memory file given, or an empty memory of the adapter's kind; none without adapter."""
    if adapter is None:
        if plan.memory is not None:
            raise CheckpointError(f"{checkpoint.folder}: has no memory adapter that could read {plan.memory}")
        return None
    maker = MemoryMaker.of(checkpoint.memory_choice(adapter))
    empty = maker.empty(info)
    if plan.memory is None:
        return empty
    memory = load_memory(plan.memory)
    check_memory(memory, empty, plan.memory)
    return memory


def check_memory(memory: Memory, wanted: Memory, path: Path) -> None:
    """Raise ``CheckpointError`` when a memory file is not what the adapter was trained to read here."""
    has, wants = memory.header(), wanted.header()
    for key in ("memory", "encoder", "encoder_settings", "channels", "reference"):
        if has[key] != wants[key]:
            raise CheckpointError(f"{path}: its {key.replace('_', ' ')} is {has[key]!r}, wanted here is {wants[key]!r}")


def roll(model: WorldModel, walk: Walk) -> Rollout:
    """Imagine the walk, clip by clip, with a progress bar."""
    before, began = copy_of(model.memory), time.monotonic()
    model.reset(walk.start, walk.info)
    parts = []
    with progress() as bar:
        task = add_task(bar, "rollout", len(walk.cameras), "frame")
        for part in model.imagine(walk.cameras, walk.interactions):
            parts.append(part)
            bar.advance(task, len(part))
    seconds, seen = time.monotonic() - began, Observations.concatenate(parts)
    return Rollout(walk, seen, before, model.memory, seconds, model.backbone.gives_depth)


def copy_of(memory: Memory | None) -> Memory | None:
    """Another memory that holds the same."""
    if memory is None:
        return None
    copy = type(memory)(memory.settings, memory.encoder, memory.reference)
    copy.restore({name: tensor.clone() for name, tensor in memory.tensors().items()})
    return copy


def describe(checkpoint: Checkpoint, adapter: str | None, plan: RolloutPlan, rollout: Rollout) -> dict[str, Any]:
    """What is needed to roll out again, JSON values."""
    options = {key: str(value) if isinstance(value, Path) else value for key, value in vars(plan).items()}
    options |= {"sampling": plan.sampling.given()}
    memory = dataclasses.asdict(rollout.memory.figures()) if rollout.memory else None
    return {
        "checkpoint": str(checkpoint.folder),
        "fingerprint": checkpoint.fingerprint,
        "plan": options | {"adapter": adapter, "actions": rollout.walk.actions},
        "frames": len(rollout.seen),
        "seconds": rollout.seconds,
        "memory": memory,
    }
