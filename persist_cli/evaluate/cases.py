"""The cases of an evaluation: which clips are predicted, the same for every row."""

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
from persist_cli.data.parquet import SUFFIX
from persist_cli.data.store import TrajectoryFile

LISTS = ("seen_before", "first_visits", "counted")  # values of a case, one for each frame


@dataclass(frozen=True)
class Case:
    """One clip to predict, by its place in a data set.

    Args:
        data: folder of the data set.
        trajectory: name of the trajectory in that folder.
        scene: name of the scene that the trajectory shows.
        start: number of the clip's first frame, which is given to the model.
        frames: length of the clip, the given frame included.
        context: number of frames at the trajectory's beginning that the memory is made of before the clip.
        seen_before: for each frame the share of its view that the frames in memory have seen, ``None`` if unknown.
        first_visits: for each frame the number of the clip's earlier frame whose place it returns to, -1 for none; see
            ``returning_frames``.
        counted: for each frame whether its pose is new, so that it counts, see ``NewPoses``.
    """

    data: str
    trajectory: str
    scene: str
    start: int
    frames: int
    context: int
    seen_before: tuple[float | None, ...]
    first_visits: tuple[int, ...]
    counted: tuple[bool, ...]

    @property
    def file(self) -> TrajectoryFile:
        """The trajectory that the clip is cut from."""
        return TrajectoryFile(Path(self.data) / f"{self.trajectory}{SUFFIX}")

    @staticmethod
    def from_json(values: dict[str, Any]) -> Case:
        """The case that ``dataclasses.asdict`` wrote as JSON."""
        lists = {key: tuple(values[key]) for key in LISTS}
        return Case(**(values | lists))


@dataclass(frozen=True)
class CaseFrames:
    """A case with its frames.

    Args:
        case: the place of the clip.
        observations: the true frames of the clip.
        interactions: what the agent did to the world in each step of the clip.
        context: frames that the memory is made of before the clip; ``None`` when it begins empty.
        info: description of the trajectory.
    """

    case: Case
    observations: Observations
    interactions: Interactions
    context: Observations | None
    info: TrajectoryInfo

    @property
    def first_visits(self) -> Int64[Tensor, " frame"]:
        """For each frame the number of the earlier frame whose place it returns to, -1 for none."""
        return torch.tensor(self.case.first_visits, dtype=torch.int64)


def read_case(case: Case) -> CaseFrames:
    """Read the clip's frames and those of its memory from the data set."""
    file = case.file
    clip = file.read(slice(case.start, case.start + case.frames))
    return CaseFrames(
        case=case,
        observations=clip.observations,
        interactions=interactions_of(clip.actions[:-1], clip.info.vocabulary),
        context=file.read(slice(0, case.context)).observations if case.context else None,
        info=clip.info,
    )


def counts(cases: Sequence[Case]) -> tuple[int, int]:
    """How many predicted frames of the cases count, and how many there are."""
    return sum(sum(case.counted[1:]) for case in cases), sum(case.frames - 1 for case in cases)


def hash_trajectories(cases: Sequence[Case]) -> list[dict[str, Any]]:
    """Each data set with the SHA-256 of every trajectory that the cases use, as JSON values."""
    hashes_by_folder: dict[str, dict[str, str]] = {}
    for case in cases:
        hashes = hashes_by_folder.setdefault(case.data, {})
        if case.trajectory not in hashes:
            hashes[case.trajectory] = case.file.sha256
    return [{"path": path, "trajectories": dict(sorted(hashes.items()))} for path, hashes in hashes_by_folder.items()]


def cases_json(cases: Sequence[Case]) -> list[dict[str, Any]]:
    """The cases and the motion of their cameras as JSON values; ``data`` is the number of the data set."""
    folders = list(dict.fromkeys(case.data for case in cases))
    return [
        dataclasses.asdict(case)
        | {"data": folders.index(case.data)}
        | path_motion(case.file.poses()[case.start : case.start + case.frames])
        for case in cases
    ]


def path_motion(poses: Float[Tensor, "frame 4 4"]) -> dict[str, float]:
    """The length of a camera path, its greatest distance from the first pose, and the sum of its turns."""
    metres, degrees = pose_differences(poses[:-1], poses[1:])
    distances, _ = pose_differences(poses[:1].expand_as(poses), poses)
    return {
        "path_metres": float(metres.sum()),
        "farthest_metres": float(distances.max()),
        "turned_degrees": float(degrees.sum()),
    }
