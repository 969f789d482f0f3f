"""``persist rollout``: imagine frames along actions and write videos, maps, poses and a memory."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor

from persist_cli.api.backbone import Backbone
from persist_cli.api.checkpoint import PLAIN, Checkpoint, find_checkpoint, reference_checkpoint
from persist_cli.api.inference import SamplingOverrides
from persist_cli.api.memory import Memory
from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.checkpoints.load import adapter_memory, load_backbone
from persist_cli.data.clips import check_size
from persist_cli.errors import CheckpointError, PersistError
from persist_cli.io.files import check_folder
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.memorize.memory_file import add_paths, load_memory, load_paths, read_header
from persist_cli.rollout.camera_path import CameraPath, Rollout, RolloutPlan, plan_camera_paths
from persist_cli.rollout.outputs import describe, path_of, summary, write_outputs
from persist_cli.rollout.world_model import Agent, WorldModel
from persist_cli.viewing.console import add_task, busy, print_json, progress, say, warn


def run_rollout(path: Path | None, plan: RolloutPlan, out: Path, as_json: bool) -> None:
    """Roll out a checkpoint, or the reference model without a path, and write a folder for each branch."""
    if bool(plan.actions) == plan.follow:
        raise PersistError("give either --actions TEXT or --follow")
    plan.placement.device()  # a missing accelerator is an error before anything is loaded
    checkpoint = find_checkpoint(path or reference_checkpoint())
    adapter = None if plan.adapter == PLAIN else plan.adapter or checkpoint.default_adapter()
    paths = plan_camera_paths(plan)
    folders = check_folders(out, len(paths))
    warn_of_short_path(plan, paths[0])
    info = paths[0].info
    with busy("loading the memory"):  # before the model, which takes longer, so that what cannot work fails at once
        memory = open_memory(checkpoint, adapter, plan, info)
    with busy("loading the model"):
        backbone = load_backbone(checkpoint, adapter=adapter)
    check_size(info, backbone.image_size, plan.start)
    sampling = checkpoint.sampling_with(plan.sampling)
    backbone.check_sampling(sampling)
    plan = dataclasses.replace(plan, sampling=SamplingOverrides(**dataclasses.asdict(sampling)))
    backbone.prepare_inference(plan.placement)
    agent = Agent(memory and memory.to(backbone.device), plan.seed, plan.write)
    model = WorldModel(backbone, [agent], sampling)
    rollouts = [dataclasses.replace(rollout, kept_paths=paths_to_keep(plan, rollout)) for rollout in roll(model, paths)]
    records = [describe(checkpoint, adapter, plan, rollout) for rollout in rollouts]
    triples = zip(rollouts, folders, records, strict=True)
    with busy("writing videos and maps"):
        figures = [write_outputs(rollout, folder, record) for rollout, folder, record in triples]
    if as_json:
        print_json(figures if len(figures) > 1 else figures[0])
        return
    for rollout, folder, record in zip(rollouts, folders, figures, strict=True):
        frames, actions = len(rollout.seen), rollout.path.text
        say(f"{frames} frames in {rollout.seconds:.1f} s along {actions!r}; written to {folder}")
        if rollout.path.truth is not None:
            say(f"mean against the true frames: {summary(record)}")


def check_folders(out: Path, branches: int) -> list[Path]:
    """Return the folder of each branch: ``out`` for a single one, or the folders 0, 1, … in it.

    Raises:
        PersistError: when ``out`` cannot be a folder, or would still hold another rollout beside several branches.
    """
    check_folder(out)
    if branches == 1:
        return [out]
    folders = [out / str(number) for number in range(branches)]
    earlier = [path.parent for path in (*out.glob("rollout.json"), *out.glob("*/rollout.json"))]
    stale = sorted(path for path in earlier if path not in folders and (path == out or path.name.isdigit()))
    if stale:
        raise PersistError(f"{stale[0]}: holds a rollout that these {branches} would not replace; take another --out")
    return folders


def open_memory(checkpoint: Checkpoint, adapter: str | None, plan: RolloutPlan, info: TrajectoryInfo) -> Memory | None:
    """Return the memory of the plan's file, else an empty one of the adapter's kind, ``None`` without an adapter."""
    if adapter is None:
        if plan.memory is not None:
            without = f"--adapter {PLAIN} is the model" if plan.adapter else f"{checkpoint.folder}: is a model"
            raise CheckpointError(f"{without} without a memory adapter, which cannot read {plan.memory}")
        return None
    empty = MemoryFactory.of(adapter_memory(checkpoint, adapter)).empty(info)
    if plan.memory is None:
        return empty
    check_memory(read_header(plan.memory), empty, checkpoint, plan.memory)
    return load_memory(plan.memory)


def paths_to_keep(plan: RolloutPlan, rollout: Rollout) -> dict[str, Tensor]:
    """Return the paths of the memory's file, and that of the rollout if its frames were written."""
    paths = load_paths(plan.memory) if plan.memory else {}
    add_paths(paths, {"rollout": path_of(rollout)} if plan.write else {})
    return paths


def check_memory(header: Mapping[str, Any], wanted: Memory, checkpoint: Checkpoint, path: Path) -> None:
    """Raise ``CheckpointError`` when a memory file differs from the kind or scene that the adapter reads.

    Args:
        header: header of the file.
        wanted: an empty memory as the adapter reads it.
        checkpoint: the checkpoint, whose other adapters may read the file.
        path: the file.
    """
    expected = json.loads(json.dumps(wanted.header()))
    for key in ("memory", "encoder", "encoder_settings", "channels", "reference"):
        if header[key] != expected[key]:
            name = key.replace("_", " ")
            readers = [one for one in checkpoint.adapters if adapter_memory(checkpoint, one).name == header["memory"]]
            advice = f"; --adapter {readers[0]} reads it" if key == "memory" and readers else ""
            raise CheckpointError(f"{path}: its {name} is {header[key]!r}, wanted here is {expected[key]!r}{advice}")


def warn_of_short_path(plan: RolloutPlan, path: CameraPath) -> None:
    """Say so when the trajectory has fewer frames to follow than the plan wants."""
    frames = len(path.cameras)
    if plan.follow and frames < plan.frames:
        warn(f"--frames {plan.frames}: only {frames} frames are left after {plan.start}; {frames} are imagined")


@contextlib.contextmanager
def on_denoised(backbone: Backbone, call: Callable[[], None]) -> Iterator[None]:
    """Within the block ``call`` is called after each denoising step, if the backbone says when one is done."""
    backbone.on_denoised = call
    try:
        yield
    finally:
        backbone.on_denoised = None


def roll(model: WorldModel, paths: Sequence[CameraPath]) -> list[Rollout]:
    """Imagine several paths from one start frame clip by clip, with a progress bar."""
    memory = model.agents[0].memory
    before, began = None if memory is None else memory.copy(), time.monotonic()
    model.reset([paths[0].start], [paths[0].info])
    branches = model.branches(len(paths)) if len(paths) > 1 else model
    cameras, clips = [path.cameras for path in paths], []
    steps, total = model.sampling.steps, sum(map(len, cameras))
    clip_count = -(-max(map(len, cameras)) // (model.backbone.frames_per_clip - 1))
    with progress() as bar:
        task = add_task(bar, "rollout", clip_count * steps, "denoising steps", f"0 of {total} frames")
        with on_denoised(model.backbone, partial(bar.advance, task)):
            for frames in branches.imagine(cameras, [path.interactions for path in paths]):
                clips.append(frames)
                done = sum(len(seen) for clip in clips for seen in clip)
                bar.update(task, completed=len(clips) * steps, note=f"{done} of {total} frames")
    seconds, depth = time.monotonic() - began, model.backbone.gives_depth
    videos = [Observations.concatenate(parts) for parts in zip(*clips, strict=True)]
    return [
        Rollout(path, video, before, agent.memory, seconds, depth)
        for path, video, agent in zip(paths, videos, branches.agents, strict=True)
    ]
