"""Samples of trajectories for learned policies: sample n depends on the seed and on n only, as with clips."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.data import Dataset

from persist_cli.api.ground import ground_axes
from persist_cli.api.policy_network import PolicySample, SampleForm
from persist_cli.data.store import Store, TrajectoryFile
from persist_cli.errors import DataError


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
    later frame of the trajectory, or any frame of another one.

    Args:
        folders: folders of the data sets; their order matters for which sample is number n.
        form: what belongs to a sample.
        seed: seed of the draws.
        mirror: share of the samples in which left and right are exchanged.

    Raises:
        DataError: when no trajectory is long enough, or images are not all of one size.
    """

    def __init__(self, folders: Sequence[Path], form: SampleForm, seed: int, mirror: float = 0.0) -> None:
        self.form, self.seed, self.mirror = form, seed, mirror
        store = [file for folder in folders for file in Store(folder)]
        needed = form.waypoints * form.spacing + 1
        self.files = [file for file in store if len(file) >= needed]
        if not self.files:
            where, longest = " and ".join(map(str, folders)), max(map(len, store))
            raise DataError(
                f"{where}: {form.waypoints} waypoints need {needed} frames, the longest trajectory has {longest}"
            )
        _check_sizes(self.files)
        self.paths: dict[int, tuple[Tensor, Tensor]] = {}  # places and headings of trajectories, as they are read

    def __getitem__(self, number: int) -> PolicySample:
        return self.read(self.choose(number))

    def choose(self, number: int) -> SampleFrames:
        """The frame numbers of sample ``number``."""
        random, form = np.random.default_rng((self.seed, number)), self.form
        file = int(random.integers(len(self.files)))
        length = len(self.files[file])
        present = int(random.integers(length - form.waypoints * form.spacing))
        steps = int(random.integers(1, min(form.farthest, (length - 1 - present) // form.spacing) + 1))
        goal_file, goal = file, present + steps * form.spacing
        if random.random() < form.negatives and len(self.files) > 1:
            goal_file = (file + int(random.integers(1, len(self.files)))) % len(self.files)
            goal = int(random.integers(len(self.files[goal_file])))
        mirrored = bool(random.random() < self.mirror)
        return SampleFrames(file, present, goal_file, goal, mirrored, int(random.integers(2**31)))

    def read(self, choice: SampleFrames) -> PolicySample:
        """The sample with these frame numbers."""
        form, file = self.form, self.files[choice.file]
        context = range(choice.present - form.context * form.spacing, choice.present + 1, form.spacing)
        frames = [max(0, frame) for frame in context]
        own = choice.goal_file == choice.file
        rgb = file.rgb([*frames, choice.goal] if own else frames)
        goal = rgb[-1] if own else self.files[choice.goal_file].rgb([choice.goal])[0]
        seen = rgb[: len(frames)]
        waypoints = self._waypoints(choice)
        if choice.mirrored:
            seen, goal, waypoints = seen.flip(2), goal.flip(1), waypoints * torch.tensor([1.0, -1.0])
        distance = (choice.goal - choice.present) // form.spacing if own else form.farthest
        leads = own and form.nearest < distance < form.farthest
        return PolicySample(seen, goal, waypoints, float(distance), leads, choice.seed)

    def _waypoints(self, choice: SampleFrames) -> Float[Tensor, "waypoint 2"]:
        """Metres ahead and to the left of the present camera, float32."""
        if choice.file not in self.paths:
            self.paths[choice.file] = ground_path(self.files[choice.file])
        places, headings = self.paths[choice.file]
        first = choice.present + self.form.spacing
        later = places[first : first + self.form.waypoints * self.form.spacing : self.form.spacing]
        return local_places(later, places[choice.present], headings[choice.present]).float()


def ground_path(file: TrajectoryFile) -> tuple[Float[Tensor, "frame 2"], Float[Tensor, "frame 2"]]:
    """The places of a trajectory's cameras on the ground axes in metres, and their headings as unit vectors there."""
    return ground_places(file.poses(), file.info.world_up)


def ground_places(
    poses: Float[Tensor, "frame 4 4"], world_up: Sequence[float]
) -> tuple[Float[Tensor, "frame 2"], Float[Tensor, "frame 2"]]:
    """The places of cameras on the ground axes in metres, and their headings as unit vectors there, float64."""
    ground = ground_axes(world_up)[:2]
    headings = poses[:, :3, 2].double() @ ground.T
    return poses[:, :3, 3].double() @ ground.T, torch.nn.functional.normalize(headings, dim=-1)


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
