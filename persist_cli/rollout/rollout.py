"""``persist rollout``: from a start frame along actions, to videos, maps, poses and a memory."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path

from persist_cli.api.checkpoint import Checkpoint, find_checkpoint
from persist_cli.api.inference import SamplingOverrides
from persist_cli.api.memory import Memory
from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.checkpoints.load import adapter_memory, load_backbone, reference_checkpoint
from persist_cli.data.clips import check_size
from persist_cli.errors import CheckpointError, PersistError
from persist_cli.io.files import check_folder
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.memorize.memory_file import load_memory
from persist_cli.rollout.camera_path import CameraPath, Rollout, RolloutPlan, plan_camera_paths
from persist_cli.rollout.outputs import describe, write_outputs
from persist_cli.rollout.world_model import Agent, WorldModel
from persist_cli.viewing.console import add_task, print_json, progress, say


def run_rollout(path: Path | None, plan: RolloutPlan, out: Path, json: bool) -> None:
    """Roll out a checkpoint, or else the reference model, and leave a folder for each branch; see its help."""
    if bool(plan.actions) == plan.follow:
        raise PersistError("give either --actions TEXT or --follow")
    plan.placement.device()  # what cannot be is told before anything is loaded
    checkpoint = find_checkpoint(path or reference_checkpoint())
    adapter = plan.adapter or checkpoint.default_adapter()
    paths = plan_camera_paths(plan)
    folders = check_folders(out, len(paths))
    info = paths[0].info
    backbone = load_backbone(checkpoint, adapter=adapter)
    check_size(info, backbone.image_size, plan.start)
    sampling = checkpoint.sampling_with(plan.sampling)
    backbone.check_sampling(sampling)
    plan = dataclasses.replace(plan, sampling=SamplingOverrides(**dataclasses.asdict(sampling)))
    backbone.prepare_inference(plan.placement)
    memory = open_memory(checkpoint, adapter, plan, info)
    agent = Agent(memory and memory.to(backbone.device), plan.seed, plan.write)
    model = WorldModel(backbone, [agent], sampling)
    rollouts = roll(model, paths)
    pairs = list(zip(rollouts, folders, strict=True))
    figures = [
        write_outputs(rollout, folder, describe(checkpoint, adapter, plan, rollout)) for rollout, folder in pairs
    ]
    if json:
        print_json(figures if len(figures) > 1 else figures[0])
        return
    for rollout, folder in pairs:
        say(
            f"{len(rollout.seen)} frames in {rollout.seconds:.1f} s along {rollout.path.actions!r}; written to {folder}"
        )


def check_folders(out: Path, branches: int) -> list[Path]:
    """Where the branches go: ``out`` for one, 0, 1, … in it for several.

    Raises:
        PersistError: when no folder can be made there, or several find rollouts there that they would not replace.
    """
    check_folder(out)
    if branches == 1:
        return [out]
    folders = [out / str(number) for number in range(branches)]
    found = [path.parent for path in (*out.glob("rollout.json"), *out.glob("*/rollout.json"))]
    left = sorted(each for each in found if each not in folders and (each == out or each.name.isdigit()))
    if left:
        raise PersistError(f"{left[0]}: holds a rollout that these {branches} would not replace; take another --out")
    return folders


def open_memory(checkpoint: Checkpoint, adapter: str | None, plan: RolloutPlan, info: TrajectoryInfo) -> Memory | None:
    """The memory file given, or an empty memory of the adapter's kind; none without adapter."""
    if adapter is None:
        if plan.memory is not None:
            raise CheckpointError(f"{checkpoint.folder}: has no memory adapter that could read {plan.memory}")
        return None
    maker = MemoryFactory.of(adapter_memory(checkpoint, adapter))
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


def roll(model: WorldModel, paths: Sequence[CameraPath]) -> list[Rollout]:
    """Imagine paths from one start together, clip by clip, with a progress bar."""
    memory = model.agents[0].memory
    before, began = None if memory is None else memory.copy(), time.monotonic()
    model.reset([paths[0].start], [paths[0].info])
    branches = model.branches(len(paths)) if len(paths) > 1 else model
    cameras, clips = [path.cameras for path in paths], []
    with progress() as bar:
        task = add_task(bar, "rollout", sum(len(way) for way in cameras), "frame")
        for frames in branches.imagine(cameras, [path.interactions for path in paths]):
            clips.append(frames)
            bar.advance(task, sum(len(seen) for seen in frames))
    seconds, depth = time.monotonic() - began, model.backbone.gives_depth
    videos = [Observations.concatenate(parts) for parts in zip(*clips, strict=True)]
    return [
        Rollout(path, video, before, agent.memory, seconds, depth)
        for path, video, agent in zip(paths, videos, branches.agents, strict=True)
    ]
