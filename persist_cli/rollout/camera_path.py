"""The plan of a rollout, its camera paths and its result."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from persist_cli.api.actions import ActionVocabulary, format_actions
from persist_cli.api.backbone import Interactions
from persist_cli.api.cameras import Cameras
from persist_cli.api.ground import Body
from persist_cli.api.memory import Memory
from persist_cli.api.observations import Observations, Trajectory, TrajectoryInfo
from persist_cli.data.clips import interactions_of
from persist_cli.data.reference import parse_reference
from persist_cli.data.store import TrajectoryFile
from persist_cli.errors import DataError, PersistError
from persist_cli.rollout.open_world import WorldOptions
from persist_cli.rollout.world_model import cameras_along


@dataclass(frozen=True, kw_only=True)
class RolloutPlan:
    """The options of ``persist rollout``; see its help.

    Args:
        world: what is rolled out, and from where.
        actions: a text of actions for each branch; none with ``follow``.
        follow: whether the trajectory's own poses are taken, along which nothing is in the way.
        frames: most of these poses, 0 for all.
        step: metres of the walking actions, ``None`` for the trajectory's own.
        turn: their degrees.
    """

    world: WorldOptions
    actions: tuple[str, ...] = ()
    follow: bool = False
    frames: int = 0
    step: float | None = None
    turn: float | None = None


@dataclass(frozen=True)
class CameraPath:
    """The start frame of a rollout and the cameras along which it goes.

    Args:
        start: the observed first frame.
        cameras: cameras of the frames to imagine, where nothing is in the way.
        interactions: interaction before each of these frames, ``None`` for none.
        actions: the action that leads to each of these frames.
        truth: true frames of these cameras when the path follows a trajectory, else ``None``.
        info: scene, up axis and vocabulary of the start frame's trajectory.
    """

    start: Observations
    cameras: Cameras
    interactions: Interactions
    actions: tuple[str, ...]
    truth: Observations | None
    info: TrajectoryInfo

    @property
    def text(self) -> str:
        """The actions as text, as in ``"forward*4 left*2"``."""
        return format_actions(self.actions)


@dataclass(frozen=True)
class Rollout:
    """The frames and memories of a rollout.

    Args:
        path: start frame and cameras.
        seen: the imagined frames.
        before: the memory before the rollout, ``None`` without one.
        memory: the memory after the rollout, ``None`` without one.
        seconds: duration of all branches together, without loading.
        gives_depth: whether the imagined frames have depth.
        kept_paths: world_from_camera of the paths that the memory's file shall keep, by name.
        remembered: world_from_camera of the frames that the memory was made of, as far as its file says.
        free: whether the way of each action was free.
        body: what could be blocked; ``None`` for a camera that goes through walls.
    """

    path: CameraPath
    seen: Observations
    before: Memory | None
    memory: Memory | None
    seconds: float
    gives_depth: bool
    kept_paths: Mapping[str, Float[Tensor, "frame 4 4"]] = field(default_factory=dict)
    remembered: Float[Tensor, "frame 4 4"] = field(default_factory=lambda: torch.zeros(0, 4, 4, dtype=torch.float64))
    free: Bool[Tensor, " action"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.bool))
    body: Body | None = None

    @property
    def blocked(self) -> list[int]:
        """The numbers of the actions that were blocked, counted from 1 as in the sheet."""
        return [number for number, free in enumerate(self.free.tolist(), 1) if not free]


def plan_camera_paths(plan: RolloutPlan) -> list[CameraPath]:
    """Return a camera path for each text of actions, or the one of the trajectory's own poses."""
    reference = parse_reference(plan.world.start)
    file = reference.single()
    if plan.follow:
        if plan.step is not None or plan.turn is not None:
            raise PersistError("--step and --turn are for --actions; --follow takes the trajectory's own poses")
        return [path_of_trajectory(file, reference.frame, plan.frames)]
    vocabulary = walking_vocabulary(file, plan.world.start, plan.step, plan.turn)
    start = file.read([reference.frame])
    start = replace(start, info=replace(start.info, vocabulary=vocabulary))
    return [path_along_actions(start, text) for text in plan.actions]


def walking_vocabulary(file: TrajectoryFile, start: str, step: float | None, turn: float | None) -> ActionVocabulary:
    """Return the actions of a trajectory, with walking actions of some size where one is given.

    Args:
        file: the trajectory.
        start: its frame, as errors name it.
        step: metres of a walking action; ``None`` with ``turn`` for the trajectory's own actions.
        turn: degrees of one.

    Raises:
        DataError: when no action moves the camera, as in a capture, and neither step nor turn is given.
    """
    own = file.info.vocabulary
    if step is not None or turn is not None:
        return own.walking(step, turn)
    if not own.can_walk:
        raise DataError(
            f"{start}: its actions ({', '.join(own.names)}) have no motion of their own, as in every capture; add "
            "--step 0.1 --turn 5 (metres and degrees of an action) here, or to `persist import` once for all rollouts"
        )
    return own


def path_along_actions(start: Trajectory, text: str) -> CameraPath:
    """Return the camera path from a single frame along actions in text form."""
    names = start.info.vocabulary.parse(text)
    cameras = cameras_along(start.observations.cameras, start.info, names)
    interactions = interactions_of(names, start.info.vocabulary)
    return CameraPath(start.observations, cameras, interactions, names, None, start.info)


def path_of_trajectory(file: TrajectoryFile, first: int, frames: int) -> CameraPath:
    """Return a trajectory's own path from frame ``first`` on, of at most ``frames`` frames (0: all) and their truth.

    Raises:
        DataError: when there is no such frame, or none after it.
    """
    (first,) = file.frame_numbers([first])
    last = min(len(file), first + 1 + frames) if frames else len(file)
    if last - first < 2:
        raise DataError(f"{file.name}: frame {first} is the last; there is nothing to follow")
    frames_read = file.read(slice(first, last))
    names = tuple(name or "stay" for name in frames_read.actions[:-1])
    return CameraPath(
        start=frames_read.observations[:1],
        cameras=frames_read.observations.cameras[1:],
        interactions=interactions_of(frames_read.actions[:-1], file.info.vocabulary),
        actions=names,
        truth=frames_read.observations[1:],
        info=file.info,
    )
