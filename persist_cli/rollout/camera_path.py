"""Where a rollout goes and what comes of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from persist_cli.api.actions import format_actions
from persist_cli.api.backbone import Interactions
from persist_cli.api.cameras import Cameras
from persist_cli.api.inference import InferenceOptions, SamplingOverrides
from persist_cli.api.memory import Memory
from persist_cli.api.observations import Observations, Trajectory, TrajectoryInfo
from persist_cli.data.clips import interactions_of
from persist_cli.data.reference import parse_reference
from persist_cli.data.store import TrajectoryFile
from persist_cli.errors import DataError
from persist_cli.rollout.world_model import cameras_along


@dataclass(frozen=True)
class RolloutPlan:
    """The options of ``persist rollout``; see its help."""

    start: str
    actions: tuple[str, ...]
    follow: bool
    frames: int
    memory: Path | None
    adapter: str | None
    write: bool
    seed: int
    sampling: SamplingOverrides
    placement: InferenceOptions


@dataclass(frozen=True)
class CameraPath:
    """Where a rollout goes.

    Args:
        start: the first frame, observed.
        cameras: of the frames to imagine.
        interactions: one for each of them.
        actions: in text form.
        truth: what is really seen there, when the trajectory is followed.
        info: of the trajectory.
    """

    start: Observations
    cameras: Cameras
    interactions: Interactions
    actions: str
    truth: Observations | None
    info: TrajectoryInfo


@dataclass(frozen=True)
class Rollout:
    """What a rollout gave.

    Args:
        path: where it went.
        seen: the frames imagined.
        before: the memory as it was, ``None`` without one.
        memory: the memory as it is now.
        seconds: that it took, without loading; all branches together.
        gives_depth: whether the depth of the imagined frames is one.
    """

    path: CameraPath
    seen: Observations
    before: Memory | None
    memory: Memory | None
    seconds: float
    gives_depth: bool


def plan_camera_paths(plan: RolloutPlan) -> list[CameraPath]:
    """The start frame and the cameras to come: by each of the texts of actions, or by the trajectory's own poses."""
    reference = parse_reference(plan.start)
    file = reference.single()
    if plan.follow:
        return [path_of_trajectory(file, reference.frame, plan.frames)]
    start = file.read([reference.frame])
    return [path_along_actions(start, text) for text in plan.actions]


def path_along_actions(start: Trajectory, text: str) -> CameraPath:
    """The way from a single frame along actions."""
    names = start.info.vocabulary.parse(text)
    cameras = cameras_along(start.observations.cameras, start.info, names)
    interactions = interactions_of(names, start.info.vocabulary)
    return CameraPath(start.observations, cameras, interactions, format_actions(names), None, start.info)


def path_of_trajectory(file: TrajectoryFile, first: int, frames: int) -> CameraPath:
    """The trajectory's own way from a frame on, with what is really seen there."""
    last = min(len(file), first + 1 + frames) if frames else len(file)
    if last - first < 2:
        raise DataError(f"{file.name}: frame {first} is the last; there is nothing to follow")
    span = file.read(slice(first, last))
    names = tuple(name or "stay" for name in span.actions[:-1])
    return CameraPath(
        start=span.observations[:1],
        cameras=span.observations.cameras[1:],
        interactions=interactions_of(span.actions[:-1], file.info.vocabulary),
        actions=format_actions(names),
        truth=span.observations[1:],
        info=file.info,
    )
