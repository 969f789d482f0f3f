"""Cases: the clips of an evaluation, found once, the same for every row."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from persist_cli.api.backbone import Interactions
from persist_cli.api.geometry import pose_differences
from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.data.clips import interactions_of
from persist_cli.data.store import SUFFIX, TrajectoryFile
from persist_cli.io.files import file_sha256


@dataclass(frozen=True)
class Case:
    """One clip to predict.

    Args:
        data: folder of the data set.
        trajectory: its name there.
        scene: whose world it shows.
        start: number of the clip's first frame, which is given.
        frames: of the clip, the given one included.
        context: how many frames at the trajectory's beginning the memory is made of before the clip.
        seen_before: for each frame the share of its view that the frames in memory have seen; ``None`` unknown.
        first_visits: for each frame the number within the clip of the frame it returns to, -1 for none.
    """

    data: str
    trajectory: str
    scene: str
    start: int
    frames: int
    context: int
    seen_before: tuple[float | None, ...]
    first_visits: tuple[int, ...]

    @property
    def file(self) -> TrajectoryFile:
        """The trajectory it is cut from."""
        return TrajectoryFile(Path(self.data) / f"{self.trajectory}{SUFFIX}")

    @staticmethod
    def from_json(values: dict[str, Any]) -> Case:
        """The case that ``dataclasses.asdict`` wrote as JSON."""
        lists = {key: tuple(values[key]) for key in ("seen_before", "first_visits")}
        return Case(**(values | lists))


@dataclass(frozen=True)
class CaseFrames:
    """A case with its frames.

    Args:
        case: which.
        observations: of the clip, ground truth.
        interactions: for each step of the clip.
        context: what the memory is made of before the clip; ``None`` when it begins empty.
        info: of the trajectory.
    """

    case: Case
    observations: Observations
    interactions: Interactions
    context: Observations | None
    info: TrajectoryInfo

    @property
    def first_visits(self) -> Int64[Tensor, " frame"]:
        """For each frame the frame it returns to, -1 for none."""
        return torch.tensor(self.case.first_visits, dtype=torch.int64)


def read_case(case: Case) -> CaseFrames:
    """The clip's frames and those of its memory."""
    file = case.file
    clip = file.read(slice(case.start, case.start + case.frames))
    return CaseFrames(
        case=case,
        observations=clip.observations,
        interactions=interactions_of(clip.actions[:-1], clip.info.vocabulary),
        context=file.read(slice(0, case.context)).observations if case.context else None,
        info=clip.info,
    )


@dataclass(frozen=True)
class Motion:
    """How much a camera moves.

    Args:
        path_metres: length of its way.
        farthest_metres: from its first pose.
        turned_degrees: sum of its turns.
    """

    path_metres: float
    farthest_metres: float
    turned_degrees: float

    @staticmethod
    def of(poses: Float[Tensor, "frame 4 4"]) -> Motion:
        """The motion of a path."""
        metres, degrees = pose_differences(poses[:-1], poses[1:])
        away, _ = pose_differences(poses[:1].expand_as(poses), poses)
        return Motion(float(metres.sum()), float(away.max()), float(degrees.sum()))


def data_files(cases: Sequence[Case]) -> list[dict[str, Any]]:
    """Each data set with the SHA-256 of every trajectory that the cases use, JSON values."""
    used: dict[str, dict[str, str]] = {}
    for case in cases:
        hashes = used.setdefault(case.data, {})
        if case.trajectory not in hashes:
            hashes[case.trajectory] = file_sha256(case.file.path)
    return [{"path": path, "trajectories": dict(sorted(hashes.items()))} for path, hashes in used.items()]


def cases_json(cases: Sequence[Case]) -> list[dict[str, Any]]:
    """The cases for the results, with how far their paths go; data sets by number."""
    folders = list(dict.fromkeys(case.data for case in cases))
    found = []
    for case in cases:
        poses = case.file.poses()[case.start : case.start + case.frames]
        values = dataclasses.asdict(case) | {"data": folders.index(case.data)}
        found.append(values | dataclasses.asdict(Motion.of(poses)))
    return found
