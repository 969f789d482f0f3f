"""Poses as TUM files: a line ``t tx ty tz qx qy qz qw`` for each frame, world_from_camera, OpenCV axes."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.checkpoint import Checkpoint
from persist_cli.api.memory import Memory
from persist_cli.api.observations import Observations
from persist_cli.io.files import write_json, write_text
from persist_cli.metrics import METRICS
from persist_cli.metrics.metric import FrameMetric, Prediction, Setup
from persist_cli.rollout.camera_path import Rollout, RolloutPlan
from persist_cli.viewing.map import draw_map
from persist_cli.viewing.sheet import write_sheet
from persist_cli.viewing.video import beside, color_depth, write_video


def quaternion(rotation: Float[Tensor, "3 3"]) -> Float[Tensor, " 4"]:
    """(qx, qy, qz, qw) with qw ≥ 0: the eigenvector of Bar-Itzhack's symmetric matrix of the largest eigenvalue."""
    r = rotation.double()
    k = torch.stack(
        [
            torch.stack([r[0, 0] - r[1, 1] - r[2, 2], r[1, 0] + r[0, 1], r[2, 0] + r[0, 2], r[2, 1] - r[1, 2]]),
            torch.stack([r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], r[2, 1] + r[1, 2], r[0, 2] - r[2, 0]]),
            torch.stack([r[2, 0] + r[0, 2], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1], r[1, 0] - r[0, 1]]),
            torch.stack([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], r.trace()]),
        ]
    )
    vector: Tensor = torch.linalg.eigh(k / 3).eigenvectors[:, -1]
    return vector if vector[3] >= 0 else -vector


def write_poses(path: Path, timestamps: Sequence[float], poses: Float[Tensor, "frame 4 4"]) -> None:
    """A TUM trajectory file, readable by evo."""
    lines = []
    for timestamp, pose in zip(timestamps, poses, strict=True):
        values = [*pose[:3, 3].tolist(), *quaternion(pose[:3, :3]).tolist()]
        lines.append(" ".join([f"{timestamp:.6f}", *(f"{value:.9f}" for value in values)]))
    write_text(path, "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(lines) + "\n")


SOMETIMES = ("compare.mp4", "map-before.png", "map-after.png", "memory.safetensors")  # what not every rollout leaves


def describe(checkpoint: Checkpoint, adapter: str | None, plan: RolloutPlan, rollout: Rollout) -> dict[str, Any]:
    """What is needed to roll out again, JSON values."""
    options = {key: str(value) if isinstance(value, Path) else value for key, value in vars(plan).items()}
    options |= {"sampling": plan.sampling.requested(), "placement": dataclasses.asdict(plan.placement)}
    memory = dataclasses.asdict(rollout.memory.figures()) if rollout.memory else None
    together = {"together": list(plan.actions)} if len(plan.actions) > 1 else {}
    return {
        "checkpoint": str(checkpoint.folder),
        "fingerprint": checkpoint.fingerprint,
        "plan": options | {"adapter": adapter, "actions": rollout.path.actions},
        "frames": len(rollout.seen),
        "seconds": rollout.seconds,
        "memory": memory,
    } | together


def write_outputs(rollout: Rollout, out: Path, figures: dict[str, Any]) -> dict[str, Any]:
    """Write everything into ``out`` in the place of an earlier rollout; gives the figures with those against truth."""
    for name in SOMETIMES:
        (out / name).unlink(missing_ok=True)
    start, seen, truth = rollout.path.start, rollout.seen, rollout.path.truth
    rgb = torch.cat([start.rgb, seen.rgb])
    depth = torch.cat([start.depth, seen.depth])
    write_video(out / "rgb.mp4", rgb)
    write_video(out / "depth.mp4", color_depth(depth))
    rows = [("generated", rgb), ("depth", color_depth(depth))]
    if truth is not None:
        true_rgb = torch.cat([start.rgb, truth.rgb])
        write_video(out / "compare.mp4", beside([true_rgb, rgb]))
        rows.insert(0, ("ground truth", true_rgb))
        figures = figures | {"against_ground_truth": compare(start, seen, truth, rollout.gives_depth)}
    write_sheet(out / "sheet.png", rows)
    write_poses(out / "poses.txt", [float(number) for number in range(len(rgb))], path_of(rollout))
    write_maps(rollout, out)
    write_json(out / "rollout.json", figures)
    return figures


def compare(
    start: Observations, seen: Observations, truth: Observations, gives_depth: bool = True
) -> dict[str, list[float]]:
    """Every metric of single frames that can be measured here, for each imagined frame.

    Args:
        start: the given frame.
        seen: the frames imagined after it.
        truth: what is really seen there.
        gives_depth: whether the depth of the imagined frames is one.
    """
    known = Observations.concatenate([start, truth])
    frames, height, width = known.depth.shape
    depth = bool((truth.depth > 0).any())
    setup = Setup(1, frames - 1, height, width, depth, gives_depth, returns=False)
    generated = (torch.cat([start.rgb, seen.rgb]), torch.cat([start.depth, seen.depth]))
    prediction = Prediction(*generated, known, torch.full((frames,), -1))
    prediction.check("rollout")
    return {
        name: metric.measure(prediction)[1:].tolist()
        for name, metric in METRICS.items()
        if isinstance(metric, FrameMetric) and metric.obstacle(setup) is None
    }


def path_of(rollout: Rollout) -> torch.Tensor:
    """Poses of the start and every imagined frame."""
    return Cameras.concatenate([rollout.path.start.cameras, rollout.seen.cameras]).world_from_camera


def write_maps(rollout: Rollout, out: Path) -> None:
    """The memory as a file, and as it was and is from above, for memories that have something to draw."""
    memories: dict[str, Memory | None] = {"map-before": rollout.before, "map-after": rollout.memory}
    for name, memory in memories.items():
        if memory is not None and len(memory.points().positions):
            draw_map(memory.points(), memory.reference.world_up, {"rollout": path_of(rollout)}, out / f"{name}.png")
    if rollout.memory is not None:
        rollout.memory.save(out / "memory.safetensors")
