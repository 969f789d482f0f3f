"""The files of a rollout: videos, a contact sheet, poses, maps, the memory and ``rollout.json``."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.checkpoint import Checkpoint
from persist_cli.api.geometry import near_poses
from persist_cli.api.memory import Memory
from persist_cli.api.nearness import NEAR_DEGREES, NEAR_METRES
from persist_cli.api.observations import Observations
from persist_cli.io.files import empty_folder_aside, remove_leftovers, write_json, write_text
from persist_cli.metrics import METRICS
from persist_cli.metrics.metric import FrameMetric, Prediction, Setup
from persist_cli.output.depth import DepthScale
from persist_cli.output.map import draw_map
from persist_cli.output.sheet import write_sheet
from persist_cli.output.video import below, beside, enlarge, labelled, still, write_video
from persist_cli.rollout.camera_path import Rollout, RolloutPlan

Video = UInt8[Tensor, "frame height width 3"]
LabelledVideos = Sequence[tuple[str, Video]]


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


CARD = "rollout.json"  # the file that makes a folder a rollout

MEMORY = "memory.safetensors"

# files of some rollouts
SOMETIMES = ("compare.mp4", "depth.mp4", "map-before.png", "map-after.png", MEMORY)

MOST_BLOCKED = 6  # blocked actions that the terminal names

PRINTED = ("psnr", "lpips-alex", "lpips-vgg")  # figures that the terminal shows


def describe(checkpoint: Checkpoint, adapter: str | None, plan: RolloutPlan, rollout: Rollout) -> dict[str, Any]:
    """Return JSON values that suffice to repeat the rollout, with its figures."""
    world = plan.world
    options = {
        "start": world.start, "actions": rollout.path.text, "follow": plan.follow, "frames": plan.frames,
        "memory": world.memory and str(world.memory), "adapter": adapter, "write": world.write, "seed": world.seed,
        "sampling": world.sampling.requested(), "placement": dataclasses.asdict(world.placement),
        "step": plan.step, "turn": plan.turn, "body": world.body,
    }  # fmt: skip
    memory = dataclasses.asdict(rollout.memory.figures()) if rollout.memory else None
    branches = {"together": list(plan.actions)} if len(plan.actions) > 1 else {}
    return {
        "checkpoint": str(checkpoint.folder),
        "fingerprint": checkpoint.fingerprint,
        "plan": options,
        "frames": len(rollout.seen),
        "seconds": rollout.seconds,
        "memory": memory,
        "body": None if rollout.body is None else dataclasses.asdict(rollout.body),
        "blocked": rollout.blocked,
    } | branches


def write_outputs(rollout: Rollout, out: Path, figures: dict[str, Any]) -> dict[str, Any]:
    """Write all files over those of an earlier rollout, once all are there; return the figures with those of the truth.

    A folder whose files are of two rollouts has no ``rollout.json``. The earlier one's memory goes after all else, as
    this one may have begun with it.
    """
    remove_leftovers(out, CARD)
    with empty_folder_aside(out / CARD) as aside:
        figures = write_files(rollout, aside, figures)
        written = sorted((path.name for path in aside.iterdir()), key=lambda name: (name == CARD, name == MEMORY))
        (out / CARD).unlink(missing_ok=True)
        for name in written:
            (aside / name).replace(out / name)
    for name in {*SOMETIMES} - {*written}:
        (out / name).unlink(missing_ok=True)
    return figures


def write_files(rollout: Rollout, out: Path, figures: dict[str, Any]) -> dict[str, Any]:
    """Write all files into an empty folder; return the figures with those against the true frames."""
    start, seen, truth = rollout.path.start, rollout.seen, rollout.path.truth
    if truth is not None:
        against = compare(start, seen, truth, rollout.gives_depth)
        counted = new_frames(rollout)
        figures = figures | {
            "against_ground_truth": against,
            "new_poses": {"metres": NEAR_METRES, "degrees": NEAR_DEGREES, "counted": counted},
            "mean_against_ground_truth": means(against, counted, frame_weights(against, start, truth)),
        }
    scale = write_pictures(rollout, out)
    figures = figures | {"depth_colors": scale and scale.to_json()}
    poses = path_of(rollout)
    write_poses(out / "poses.txt", [float(number) for number in range(len(poses))], poses)
    write_maps(rollout, out)
    write_json(out / CARD, figures)
    return figures


def write_pictures(rollout: Rollout, out: Path) -> DepthScale | None:
    """Write the videos and the contact sheet; return the scale of all depth in them, ``None`` without depth."""
    start, truth = rollout.path.start, rollout.path.truth
    rgb = torch.cat([start.rgb, rollout.seen.rgb])
    rows = [("generated", rgb)]
    if truth is not None:
        rows.insert(0, ("ground truth", torch.cat([start.rgb, truth.rgb])))
    depths = depths_of(rollout)
    scale = DepthScale.of(list(depths.values())) if depths else None
    colored = [] if scale is None else [(name, scale.color(depth)) for name, depth in depths.items()]
    write_video(out / "rgb.mp4", rgb)
    if scale is not None:
        write_video(out / "depth.mp4", with_bar(enlarge(colored[-1][1]), scale))
    if truth is not None:
        write_video(out / "compare.mp4", comparison(rows, colored, scale))
    actions = [f"{number} {action}" for number, action in enumerate(("start", *rollout.path.actions))]
    actions = [f"{n} blocked" if n in rollout.blocked else text for n, text in enumerate(actions)]
    write_sheet(out / "sheet.png", rows + colored, actions, bar=None if scale is None else scale.bar)
    return scale


def depths_of(rollout: Rollout) -> dict[str, Float[Tensor, "frame height width"]]:
    """Return true depth, where the rollout has it, and generated depth in metres, each with the start frame's."""
    start, seen, truth = rollout.path.start, rollout.seen, rollout.path.truth
    if not rollout.gives_depth:
        return {}
    generated = {"generated depth": torch.cat([start.depth, seen.depth])}
    if truth is None or not bool((truth.depth > 0).any()):
        return generated
    return {"true depth": torch.cat([start.depth, truth.depth])} | generated


def comparison(rows: LabelledVideos, depths: LabelledVideos, scale: DepthScale | None) -> Video:
    """Return the labelled videos side by side, and their depths, if any, with the bar of their scale below."""
    pair = beside([labelled(enlarge(video), label) for label, video in rows])
    if scale is None or len(depths) < len(rows):
        return pair
    return with_bar(below([pair, beside([labelled(enlarge(video), label) for label, video in depths])]), scale)


def with_bar(video: Video, scale: DepthScale) -> Video:
    """Return the video above the bar of its depth colours."""
    return below([video, still(scale.bar(video.shape[2]), len(video))])


def new_frames(rollout: Rollout) -> list[bool]:
    """Return for each imagined frame whether its pose is new: not near the start frame or one of the memory's file."""
    known = torch.cat([rollout.remembered, rollout.path.start.cameras.world_from_camera.double()])
    near = near_poses(rollout.seen.cameras.world_from_camera.double(), known)
    return [not bool(frames.any()) for frames in near]


def means(
    figures: Mapping[str, Sequence[float]], counted: Sequence[bool], weights: Mapping[str, Tensor]
) -> dict[str, float]:
    """Return the mean of each figure over the frames that count and have it; a figure of no such frame is left out.

    Args:
        figures: figures of each imagined frame, by metric, NaN where there is none.
        counted: whether a frame's pose is new.
        weights: how much each frame counts, by metric, see ``frame_weights``.
    """
    averages = {}
    for name, numbers in figures.items():
        values = torch.tensor(numbers, dtype=torch.float64)
        known = torch.where(torch.tensor(counted) & values.isfinite(), weights[name], 0.0)
        if bool(known.sum() > 0):
            averages[name] = float((values.nan_to_num() * known).sum() / known.sum())
    return averages


def frame_weights(names: Iterable[str], start: Observations, truth: Observations) -> dict[str, Float[Tensor, " frame"]]:
    """Return how much each imagined frame counts in the mean of each metric, by the true frames alone.

    Args:
        names: names of metrics of single frames.
        start: the observed first frame.
        truth: the true frames after it.
    """
    known = Observations.concatenate([start, truth])
    prediction = Prediction(known.rgb, known.depth, known, torch.full((len(known),), -1))
    metrics = {name: metric for name in names if isinstance(metric := METRICS[name], FrameMetric)}
    return {name: metric.frame_weights(prediction)[1:] for name, metric in metrics.items()}


def counted_words(figures: Mapping[str, Any]) -> str:
    """Return which frames the means count, where these are not all: no others are near one in memory."""
    counted = figures["new_poses"]["counted"]
    if all(counted):
        return ""
    limits = f"{figures['new_poses']['metres']:g} m and {figures['new_poses']['degrees']:g}°"
    return f" ({sum(counted)} of {len(counted)} count: those farther than {limits} from every remembered frame)"


def blocked_words(rollout: Rollout) -> str:
    """Return which actions were blocked, as in ``"3 of 9 actions (7 forward, 8 forward, 9 forward)"``."""
    blocked = [f"{number} {rollout.path.actions[number - 1]}" for number in rollout.blocked]
    shown = blocked[:MOST_BLOCKED] + ["…"] * (len(blocked) > MOST_BLOCKED)
    return f"{len(blocked)} of {len(rollout.path.actions)} actions ({', '.join(shown)})"


def summary(figures: Mapping[str, Any]) -> str:
    """Return the means against the true frames that the terminal shows, as in ``"PSNR 21.34, LPIPS-Alex 0.3127"``."""
    measured = figures["mean_against_ground_truth"]
    return ", ".join(f"{METRICS[name].title} {measured[name]:.4g}" for name in PRINTED if name in measured) or "none"


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
    setup = Setup(
        clips=1, frames=frames - 1, height=height, width=width, depth=depth, generated_depth=gives_depth, returns=False
    )
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
    stops = rollout.seen.cameras.world_from_camera[[number - 1 for number in rollout.blocked]]
    memories: dict[str, Memory | None] = {"map-before": rollout.before, "map-after": rollout.memory}
    for name, memory in memories.items():
        if memory is not None and len(memory.points().positions):
            draw_map(
                memory.points(), memory.reference.world_up, {"rollout": path_of(rollout)}, out / f"{name}.png", stops
            )
    if rollout.memory is not None:
        rollout.memory.save(out / MEMORY, rollout.kept_paths)
