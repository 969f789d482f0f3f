"""The files of a rollout: videos, a contact sheet, poses, maps, the memory and ``rollout.json``."""

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
    """Return a rotation as (qx, qy, qz, qw) with qw ≥ 0, by Bar-Itzhack's symmetric matrix and its last eigenvector."""
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
    """Write lines ``t tx ty tz qx qy qz qw`` (TUM), seconds and metres, from world_from_camera poses in OpenCV axes."""
    lines = []
    for timestamp, pose in zip(timestamps, poses, strict=True):
        values = [*pose[:3, 3].tolist(), *quaternion(pose[:3, :3]).tolist()]
        lines.append(" ".join([f"{timestamp:.6f}", *(f"{value:.9f}" for value in values)]))
    write_text(path, "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(lines) + "\n")


SOMETIMES = ("compare.mp4", "map-before.png", "map-after.png", "memory.safetensors")  # files of some rollouts


def describe(checkpoint: Checkpoint, adapter: str | None, plan: RolloutPlan, rollout: Rollout) -> dict[str, Any]:
    """Return JSON values that suffice to repeat the rollout, with its figures."""
    options = {key: str(value) if isinstance(value, Path) else value for key, value in vars(plan).items()}
    options |= {"sampling": plan.sampling.requested(), "placement": dataclasses.asdict(plan.placement)}
    memory = dataclasses.asdict(rollout.memory.figures()) if rollout.memory else None
    branches = {"together": list(plan.actions)} if len(plan.actions) > 1 else {}
    return {
        "checkpoint": str(checkpoint.folder),
        "fingerprint": checkpoint.fingerprint,
        "plan": options | {"adapter": adapter, "actions": rollout.path.text},
        "frames": len(rollout.seen),
        "seconds": rollout.seconds,
        "memory": memory,
    } | branches


def write_outputs(rollout: Rollout, out: Path, figures: dict[str, Any]) -> dict[str, Any]:
    """Write all files over those of an earlier rollout; return the figures with those against the true frames."""
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
    """Return the figures of each imagined frame for every metric of single frames that can be measured.

    Args:
        start: the observed first frame.
        seen: the frames imagined after it.
        truth: the true frames of the same cameras.
        gives_depth: whether the imagined frames have depth.
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
    """Return world_from_camera of the start frame and every imagined frame."""
    return Cameras.concatenate([rollout.path.start.cameras, rollout.seen.cameras]).world_from_camera


def write_maps(rollout: Rollout, out: Path) -> None:
    """Write the memory, and maps of it before and after the rollout when it has points to draw."""
    memories: dict[str, Memory | None] = {"map-before": rollout.before, "map-after": rollout.memory}
    for name, memory in memories.items():
        if memory is not None and len(memory.points().positions):
            draw_map(memory.points(), memory.reference.world_up, {"rollout": path_of(rollout)}, out / f"{name}.png")
    if rollout.memory is not None:
        rollout.memory.save(out / "memory.safetensors", rollout.kept_paths)
