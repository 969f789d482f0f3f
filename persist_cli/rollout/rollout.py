"""``persist rollout``: imagine frames along actions and write videos, maps, poses and a memory."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import torch

from persist_cli.api.backbone import Backbone
from persist_cli.api.checkpoint import find_checkpoint, reference_checkpoint
from persist_cli.api.inference import SamplingOverrides
from persist_cli.checkpoints.lineage import training_scenes
from persist_cli.checkpoints.placement import check_placement
from persist_cli.data.cameras import unfamiliar_view
from persist_cli.errors import PersistError
from persist_cli.io.files import check_folder
from persist_cli.memorize.memory_file import add_paths, load_paths
from persist_cli.output.console import add_task, busy, print_json, progress, say, warn
from persist_cli.rollout.camera_path import CameraPath, Rollout, RolloutPlan, plan_camera_paths
from persist_cli.rollout.open_world import WorldOptions, assemble_world
from persist_cli.rollout.outputs import CARD, blocked_words, counted_words, describe, path_of, summary, write_outputs
from persist_cli.rollout.world_model import StepResult, WorldModel


def run_rollout(path: Path | None, plan: RolloutPlan, out: Path, as_json: bool) -> None:
    """Roll out a checkpoint, or the reference model without a path, and write a folder for each branch."""
    if bool(plan.actions) == plan.follow:
        raise PersistError("give either --actions TEXT or --follow")
    if plan.world.body is not None and plan.follow:
        raise PersistError("--body and --no-body are for --actions; --follow takes the trajectory's own poses")
    if plan.frames and not plan.follow:
        raise PersistError("--frames: only with --follow; with --actions each of them is a frame")
    check_placement(plan.world.placement)  # a missing accelerator is an error before anything is loaded
    checkpoint = find_checkpoint(path or reference_checkpoint())
    adapter = checkpoint.chosen_adapter(plan.world.adapter)
    paths = plan_camera_paths(plan)
    folders = check_folders(out, len(paths))
    warn_of_short_path(plan, paths[0])
    view = unfamiliar_view([paths[0].info], training_scenes(checkpoint))
    if view is not None:
        warn(f"warning: {view}")
    options = dataclasses.replace(plan.world, body=False) if plan.follow else plan.world  # nothing stops given poses
    model = assemble_world(checkpoint, adapter, options, paths[0].info)
    sampling = SamplingOverrides(**dataclasses.asdict(model.sampling))
    plan = dataclasses.replace(plan, world=dataclasses.replace(plan.world, sampling=sampling))
    rollouts = [with_paths(plan.world, rollout) for rollout in roll(model, paths)]
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
        if rollout.blocked:
            say(f"blocked, so that the agent stayed where it was: {blocked_words(rollout)}")
        if rollout.path.truth is not None:
            say(f"mean against the true frames{counted_words(record)}: {summary(record)}")


def check_folders(out: Path, branches: int) -> list[Path]:
    """Return the folder of each branch: ``out`` for a single one, or the folders 0, 1, … in it.

    Raises:
        PersistError: when ``out`` cannot be a folder, or would still hold another rollout beside the new ones.
    """
    check_folder(out)
    folders = [out] if branches == 1 else [out / str(number) for number in range(branches)]
    earlier = [path.parent for path in (*out.glob(CARD), *out.glob(f"*/{CARD}"))]
    stale = sorted(path for path in earlier if path not in folders and (path == out or path.name.isdigit()))
    if stale:
        new = "this one" if branches == 1 else f"these {branches}"
        raise PersistError(f"{stale[0]}: holds a rollout that {new} would not replace; take another --out")
    return folders


def with_paths(options: WorldOptions, rollout: Rollout) -> Rollout:
    """Return a rollout with the paths of the memory's file, and to be kept also its own if its frames were written."""
    paths = load_paths(options.memory) if options.memory else {}
    remembered = torch.cat([rollout.remembered, *(poses.double() for poses in paths.values())])
    add_paths(paths, {"rollout": path_of(rollout)} if options.write else {})
    return dataclasses.replace(rollout, kept_paths=paths, remembered=remembered)


def warn_of_short_path(plan: RolloutPlan, path: CameraPath) -> None:
    """Say so when the trajectory has fewer frames to follow than the plan wants."""
    frames = len(path.cameras)
    if plan.follow and frames < plan.frames:
        warn(f"--frames {plan.frames}: only {frames} frames are left after {plan.world.start}; {frames} are imagined")


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
    left, clips = [len(path.actions) for path in paths], []
    steps, total, length = model.sampling.steps, sum(left), model.clip_frames - 1
    with progress() as bar:
        task = add_task(bar, "rollout", -(-max(left) // length) * steps, "denoising steps", f"0 of {total} frames")
        with on_denoised(model.backbone, partial(bar.advance, task)):
            for results in clips_along(branches, paths):
                clips.append(results)
                left = [count - len(result.seen) for count, result in zip(left, results, strict=True)]
                expected = len(clips) + -(-max(left) // length)  # more than at first where an agent was stopped
                note = f"{total - sum(left)} of {total} frames"
                bar.update(task, completed=len(clips) * steps, total=expected * steps, note=note)
    seconds, depth = time.monotonic() - began, model.backbone.gives_depth
    results = [StepResult.concatenate(parts) for parts in zip(*clips, strict=True)]
    return [
        Rollout(path, result.seen, before, agent.memory, seconds, depth, free=result.free, body=agent.body)
        for path, result, agent in zip(paths, results, branches.agents, strict=True)
    ]


def clips_along(model: WorldModel, paths: Sequence[CameraPath]) -> Iterator[list[StepResult]]:
    """Imagine each clip of some paths: where their actions lead, or along the poses of a trajectory."""
    if all(path.truth is None for path in paths):
        yield from model.act([path.actions for path in paths])
        return
    if any(agent.scene is not None for agent in model.agents) and any(any(path.interactions) for path in paths):
        warn("warning: along given poses interactions do not change the scene; --actions, without --follow, does it")
    for frames in model.imagine([path.cameras for path in paths], [path.interactions for path in paths]):
        yield [StepResult(seen, torch.ones(len(seen), dtype=torch.bool)) for seen in frames]
