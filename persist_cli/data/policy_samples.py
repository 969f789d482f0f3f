"""Samples of trajectories for learned policies: sample n depends on the seed and on n only, as with clips."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn import functional
from torch.utils.data import Dataset

from persist_cli.api.ground import ground_axes
from persist_cli.api.policy_network import PolicySample, SampleForm
from persist_cli.data.store import Store, TrajectoryFile
from persist_cli.errors import DataError

MOST_DRAWS: Final = 1000  # of a moment, before it is said that hardly any leads somewhere directly

ANY_WAY: Final = 0.5  # share of the samples whose goal may be one that the trajectory wandered to

ROUNDING: Final = 1e-3  # metres, radians and frames that rounded poses may be wrong by


@dataclass(frozen=True)
class SampleFrames:
    """The frame numbers of one sample, drawn before anything of it is read.

    Args:
        file: number of the trajectory.
        present: number of the present frame.
        goal_file: number of the trajectory of the goal.
        goal: number of the goal's frame there.
        mirrored: whether left and right are exchanged.
        seed: seed of everything else that is random about the sample.
    """

    file: int
    present: int
    goal_file: int
    goal: int
    mirrored: bool
    seed: int


class PolicySampleDataset(Dataset[PolicySample]):
    """Endless samples of some data sets; sample n depends on the seed and on n only.

    The frames before a trajectory's first one are that one again, as for an agent that has just begun. A goal is a
    later frame of the trajectory, or any frame of another one, which counts as far away.

    With ``detour`` trajectories may wander about. Then a sample leads only to what the trajectory came to more or less
    directly. In half of the samples any later frame is the goal: of one that was reached by wandering, the sample says
    how far it is and not how to get there. Else all goals would be near, and a policy would take any goal for near.
    Frames of other trajectories of the same scene count as far as they are.

    Args:
        folders: folders of the data sets; their order matters for which sample is number n.
        form: what belongs to a sample.
        seed: seed of the draws.
        mirror: share of the samples in which left and right are exchanged.
        detour: what the trajectory came to in more than so many times the frames of the direct way counts as wandering,
            and as so far; see ``GroundPath.direct_frames``. ``None``: whatever it came to is a goal to be led to.

    Raises:
        DataError: when no trajectory is long enough, or images are not all of one size.
    """

    def __init__(
        self, folders: Sequence[Path], form: SampleForm, seed: int, mirror: float = 0.0, detour: float | None = None
    ) -> None:
        self.form, self.seed, self.mirror, self.detour = form, seed, mirror, detour
        store = [file for folder in folders for file in Store(folder)]
        needed = form.waypoints * form.spacing + 1
        self.files = [file for file in store if len(file) >= needed]
        if not self.files:
            where, longest = " and ".join(map(str, folders)), max(map(len, store))
            raise DataError(
                f"{where}: {form.waypoints} waypoints need {needed} frames, the longest trajectory has {longest}"
            )
        _check_sizes(self.files)
        self.paths: dict[int, GroundPath] = {}  # of trajectories, as they are read

    def __getitem__(self, number: int) -> PolicySample:
        return self.read(self.choose(number))

    def choose(self, number: int) -> SampleFrames:
        """The frame numbers of sample ``number``."""
        random, form = np.random.default_rng((self.seed, number)), self.form
        file, present, goal = self._moment(random)
        goal_file = file
        if random.random() < form.negatives and len(self.files) > 1:
            goal_file = (file + int(random.integers(1, len(self.files)))) % len(self.files)
            goal = int(random.integers(len(self.files[goal_file])))
        mirrored = bool(random.random() < self.mirror)
        return SampleFrames(file, present, goal_file, goal, mirrored, int(random.integers(2**31)))

    def _moment(self, random: np.random.Generator) -> tuple[int, int, int]:
        """Draw the number of a trajectory, that of its present frame, and that of a later frame to be the goal."""
        for _ in range(MOST_DRAWS):
            file = int(random.integers(len(self.files)))
            present = int(random.integers(len(self.files[file]) - self.form.waypoints * self.form.spacing))
            later = self._later(file, present)
            goals = self._direct(file, present, later)
            if len(goals):
                goals = later if self.detour is not None and random.random() < ANY_WAY else goals
                return file, present, int(goals[int(random.integers(len(goals)))])
        raise DataError(
            f"{self.files[0].path.parent}: {MOST_DRAWS} moments drawn, and none leads to a later frame within "
            f"{self.detour:g} times the frames of the direct way; raise data.detour"
        )

    def _later(self, file: int, present: int) -> Int64[Tensor, " goal"]:
        """The numbers of the later frames of a trajectory that are not too far to be the goal."""
        spacing, last = self.form.spacing, len(self.files[file]) - 1
        return torch.arange(present + spacing, min(last, present + self.form.farthest * spacing) + 1, spacing)

    def _direct(self, file: int, present: int, later: Int64[Tensor, " goal"]) -> Int64[Tensor, " direct"]:
        """Those of some later frames that the trajectory did not wander to."""
        if self.detour is None:
            return later
        path = self._path(file)
        return later[later - present <= self.detour * path.direct_frames(present, path, later) + ROUNDING]

    def read(self, choice: SampleFrames) -> PolicySample:
        """The sample with these frame numbers."""
        form, file = self.form, self.files[choice.file]
        context = range(choice.present - form.context * form.spacing, choice.present + 1, form.spacing)
        frames = [max(0, frame) for frame in context]
        own = choice.goal_file == choice.file
        rgb = file.rgb([*frames, choice.goal] if own else frames)
        goal = rgb[-1] if own else self.files[choice.goal_file].rgb([choice.goal])[0]
        seen = rgb[: len(frames)]
        waypoints, place = self._waypoints(choice), self._goal_place(choice) if own else torch.zeros(4)
        if choice.mirrored:
            seen, goal, waypoints = seen.flip(2), goal.flip(1), waypoints * torch.tensor([1.0, -1.0])
            place = place * torch.tensor([1.0, -1.0, 1.0, -1.0])
        distance, wandered = self._distance(choice)
        leads = own and not wandered and form.nearest < distance < form.farthest
        return PolicySample(seen, goal, waypoints, distance, place, leads, choice.seed)

    def _distance(self, choice: SampleFrames) -> tuple[float, bool]:
        """The spacings of frames to the goal, and whether the trajectory wandered there, or did not come there."""
        form, own = self.form, choice.goal_file == choice.file
        frames = choice.goal - choice.present if own else form.farthest * form.spacing
        here, there = (self.files[number].info.scene for number in (choice.file, choice.goal_file))
        if self.detour is None or here != there:
            return float(frames // form.spacing), not own
        path, goals = self._path(choice.goal_file), torch.tensor([choice.goal])
        most = self.detour * float(self._path(choice.file).direct_frames(choice.present, path, goals)) + ROUNDING
        return float(min(frames, most) // form.spacing), not own or frames > most

    def _waypoints(self, choice: SampleFrames) -> Float[Tensor, "waypoint 2"]:
        """Metres ahead and to the left of the present camera, float32."""
        path, first = self._path(choice.file), choice.present + self.form.spacing
        later = path.places[first : first + self.form.waypoints * self.form.spacing : self.form.spacing]
        return local_places(later, path.places[choice.present], path.headings[choice.present]).float()

    def _goal_place(self, choice: SampleFrames) -> Float[Tensor, " 4"]:
        """Metres ahead and to the left of the present camera, and the heading at the goal as a unit vector there."""
        path, present = self._path(choice.file), choice.present
        place = local_places(path.places[choice.goal], path.places[present], path.headings[present])
        heading = local_places(path.headings[choice.goal], torch.zeros(2).double(), path.headings[present])
        return torch.cat([place, heading]).float()

    def _path(self, number: int) -> GroundPath:
        """The path of a trajectory, which is read once."""
        if number not in self.paths:
            file = self.files[number]
            self.paths[number] = GroundPath(*ground_places(file.poses(), file.info.world_up))
        return self.paths[number]


@dataclass(frozen=True)
class GroundPath:
    """Where the cameras of a trajectory are on the ground.

    Args:
        places: metres on the ground axes, float64.
        headings: unit vectors there, float64.
    """

    places: Float[Tensor, "frame 2"]
    headings: Float[Tensor, "frame 2"]

    def direct_frames(self, start: int, path: GroundPath, ends: Int64[Tensor, " end"]) -> Float[Tensor, " end"]:
        """Return how many frames the direct way takes from one frame to others, if nothing is in between.

        That is to turn to the place, to go straight there, and to turn to the heading, each at the greatest speed of
        this path, or of the other one where this one never goes or never turns; infinitely many where neither does. For
        an agent that steps and turns by fixed amounts it is the number of its actions.

        Args:
            start: number of the frame where the way begins.
            path: on which it ends, this one or another one of the same scene.
            ends: numbers of frames of that path.
        """
        way = path.places[ends] - self.places[start]
        metres, ahead = way.norm(dim=-1), functional.normalize(way, dim=-1)
        before, after = self.headings[start].expand_as(ahead), path.headings[ends]
        ahead = torch.where(metres[:, None] > ROUNDING, ahead, before)  # there is no way to turn to
        step, turn = (own or other for own, other in zip(self._speeds, path._speeds, strict=True))
        frames: Tensor = _over(metres, step) + _over(_angles(before, ahead), turn) + _over(_angles(ahead, after), turn)
        return frames

    @cached_property
    def _speeds(self) -> tuple[float, float]:
        """The most metres and radians from one frame to the next, 0 where it never goes, or never turns."""
        metres = (self.places[1:] - self.places[:-1]).norm(dim=-1).max()
        radians = _angles(self.headings[:-1], self.headings[1:]).max()
        step, turn = (float(speed) if speed > ROUNDING else 0.0 for speed in (metres, radians))
        return step, turn


def _over(amounts: Float[Tensor, " row"], speed: float) -> Float[Tensor, " row"]:
    """The frames that amounts take at a speed: none for nothing, infinitely many at a speed of 0."""
    return torch.where(amounts > ROUNDING, amounts / speed if speed else math.inf, 0.0)


def _angles(first: Float[Tensor, "row 2"], second: Float[Tensor, "row 2"]) -> Float[Tensor, " row"]:
    """The angle between unit vectors in radians, 0…π."""
    across = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    return torch.atan2(across.abs(), (first * second).sum(-1))


def ground_places(
    poses: Float[Tensor, "frame 4 4"], world_up: Sequence[float]
) -> tuple[Float[Tensor, "frame 2"], Float[Tensor, "frame 2"]]:
    """The places of cameras on the ground axes in metres, and their headings as unit vectors there, float64."""
    ground = ground_axes(world_up)[:2]
    headings = poses[:, :3, 2].double() @ ground.T
    return poses[:, :3, 3].double() @ ground.T, functional.normalize(headings, dim=-1)


def local_places(
    places: Float[Tensor, "place 2"], origin: Float[Tensor, " 2"], heading: Float[Tensor, " 2"]
) -> Float[Tensor, "place 2"]:
    """Places on the ground axes as metres ahead and to the left of an agent.

    Args:
        places: metres on the ground axes.
        origin: the agent's place there.
        heading: the agent's heading there, a unit vector.
    """
    left = torch.stack([-heading[1], heading[0]])
    return (places - origin) @ torch.stack([heading, left]).T


def _check_sizes(files: Sequence[TrajectoryFile]) -> None:
    first = files[0]
    for file in files:
        if (file.info.height, file.info.width) != (first.info.height, first.info.width):
            raise DataError(
                f"{file.path}: images are {file.info.height}x{file.info.width}, those of {first.path} are "
                f"{first.info.height}x{first.info.width}; a policy is trained on images of one size"
            )
