"""Memory interventions: what a row's memory is made of, to show whether and how the model uses it."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from persist_cli.api.cameras import Cameras, invert_rigid
from persist_cli.api.cells import CellGrid
from persist_cli.api.geometry import small_motions
from persist_cli.api.memory import Memory
from persist_cli.api.observations import Observations
from persist_cli.api.scene import Scene
from persist_cli.evaluate.cases import Case, CaseFrames, read_case

Disturb = Callable[[Observations], Observations]

WRITTEN = "every pose written to its memory"

DRIFT_FRAMES = 32  # after which drifting poses are off by their standard deviation


class MemoryIntervention(ABC):
    """A rule for what is written into a row's memory.

    ``writes`` says whether the model's own output may follow, ``holds`` what the memory holds before, ``poses``
    whether its poses are true, and ``memories`` which memories it is for.
    """

    name: ClassVar[str]
    holds: ClassVar[str] = "true frames"
    poses: ClassVar[str] = "true"
    writes: ClassVar[bool] = False
    memories: ClassVar[type] = Memory  # a class of memories

    @property
    @abstractmethod
    def definition(self) -> str:
        """A few words that say what the memory holds."""

    @abstractmethod
    def context(self, clip: CaseFrames) -> Observations | None:
        """The frames that a clip's memory is made of before the clip begins; ``None`` for none."""

    def cells(self, clip: CaseFrames) -> CellGrid | None:
        """The cells that a clip's memory, a scene, begins with; ``None``, the default, for none."""
        return None

    def disturb(self, seen: Observations, draws: torch.Generator) -> Observations:
        """Change frames on their way into the memory; by default they stay as they are."""
        return seen

    def disturber(self, clip: CaseFrames, seed: int) -> Disturb:
        """A function that changes the frames that are written into a clip's memory, called in their order."""
        return partial(self.disturb, draws=torch.Generator().manual_seed(seed))


class Unmodified(MemoryIntervention):
    """The memory of the protocol, without an intervention."""

    name = ""
    writes = True
    definition = "memory as the protocol says"

    def context(self, clip: CaseFrames) -> Observations | None:
        """The frames before the clip."""
        return clip.context


class Emptied(MemoryIntervention):
    """A memory that is always empty."""

    name = "emptied"
    holds = "nothing"
    definition = "its memory is always empty"

    def context(self, clip: CaseFrames) -> Observations | None:
        """Always ``None``: the memory begins empty."""
        return None


class Oracle(MemoryIntervention):
    """A memory that holds the true frames to be predicted, too."""

    name = "oracle"
    holds = "true frames, those of the clip too,"
    definition = "its memory holds the true frames of the clip too"

    def context(self, clip: CaseFrames) -> Observations | None:
        """The frames before the clip and those of the clip."""
        earlier = [] if clip.context is None else [clip.context]
        return Observations.concatenate([*earlier, clip.observations])


class TrueCells(MemoryIntervention):
    """A scene whose cells are those of the data, all of them known."""

    name = "true cells"
    holds = "the true cells of the scene"
    definition = "its scene is the data's own grid of cells, all of them known: what a perfect scene would give"
    memories = Scene

    def context(self, clip: CaseFrames) -> Observations | None:
        """Always ``None``: the cells hold all there is."""
        return None

    def cells(self, clip: CaseFrames) -> CellGrid:
        """The cells at the clip's first frame."""
        return clip.case.file.cells(clip.case.start)


class Shuffled(MemoryIntervention):
    """The memory of another clip, in another scene.

    Args:
        cases: all cases of the evaluation; each gets the memory of the next one in another scene, so there must be
            two scenes, see ``one_scene``.
    """

    name = "shuffled"
    holds = "true frames of another scene"
    definition = "its memory is that of the next clip in another scene, moved to where this clip begins"

    def __init__(self, cases: Sequence[Case]) -> None:
        self.cases = cases

    @cached_property
    def partners(self) -> dict[Case, Case]:
        """For each case the one whose memory it gets."""
        return {case: next_in_another_scene(self.cases, number) for number, case in enumerate(self.cases)}

    def context(self, clip: CaseFrames) -> Observations | None:
        """The partner's frames, moved so that the partner begins where this clip begins."""
        partner = read_case(self.partners[clip.case])
        frames = partner.context if partner.context is not None else partner.observations
        here = clip.observations.cameras.world_from_camera[0]
        there = partner.observations.cameras.world_from_camera[0]
        return replace(frames, cameras=move_cameras(frames.cameras, here @ invert_rigid(there)))


@dataclass(frozen=True)
class NoisyPoses(MemoryIntervention):
    """A memory that is written with wrong poses: each has an error of its own, independent of the others (white noise).

    Args:
        centimetres: standard deviation of the error along each axis.
        degrees: standard deviation of the error about each axis.
    """

    centimetres: float = 5.0
    degrees: float = 2.0
    name = "noisy poses (white)"
    poses = "wrong"
    writes = True

    @property
    def definition(self) -> str:
        """A sentence with both standard deviations."""
        return f"{WRITTEN} is off by σ = {self.amount}, in each frame independently (white noise)"

    @property
    def amount(self) -> str:
        """Both standard deviations."""
        return f"{self.centimetres:g} cm along and {self.degrees:g}° about each camera axis"

    def context(self, clip: CaseFrames) -> Observations | None:
        """The frames before the clip."""
        return clip.context

    def disturb(self, seen: Observations, draws: torch.Generator) -> Observations:
        """Move and turn each pose by an error of its own."""
        return self.moved(seen, torch.randn(len(seen), 6, generator=draws, dtype=torch.float64))

    def moved(self, seen: Observations, errors: Float[Tensor, "frame 6"]) -> Observations:
        """The frames, each pose moved and turned in its camera's axes by so many standard deviations."""
        metres, radians = errors[:, :3] * self.centimetres / 100, errors[:, 3:] * math.radians(self.degrees)
        wrong = seen.cameras.world_from_camera @ small_motions(metres, radians)
        return replace(seen, cameras=replace(seen.cameras, world_from_camera=wrong))


@dataclass(frozen=True)
class DriftingPoses(NoisyPoses):
    """A memory that is written with poses that drift as odometry does: the error is a random walk.

    It is zero where the clip begins, since a model knows where it is by where it was just now. Frames before and after
    are the farther off the longer ago, or later, they were seen.
    """

    name = "noisy poses (drift)"

    @property
    def definition(self) -> str:
        """A sentence with both standard deviations and when they are reached."""
        return (
            f"{WRITTEN} is off by a random walk, zero where the clip begins and of σ = {self.amount} after "
            f"{DRIFT_FRAMES} frames (drift)"
        )

    def disturber(self, clip: CaseFrames, seed: int) -> Disturb:
        """A walk backward through the frames before the clip, and forward through those that are written then."""
        draws, now = torch.Generator().manual_seed(seed), torch.zeros(6, dtype=torch.float64)
        first = True

        def drift(seen: Observations) -> Observations:
            nonlocal now, first
            steps = torch.randn(len(seen), 6, generator=draws, dtype=torch.float64) / math.sqrt(DRIFT_FRAMES)
            backward = first and clip.context is not None
            if first:
                steps[0], first = 0.0, False
            walk = now + steps.cumsum(0)
            if backward:
                return self.moved(seen, walk.flip(0))
            now = walk[-1]
            return self.moved(seen, walk)

        return drift


def one_scene(cases: Sequence[Case]) -> str | None:
    """The reason why memories cannot be shuffled among these cases, ``None`` when they are of two scenes or more."""
    scenes = {case.scene for case in cases}
    return f"needs clips of two scenes, all are of {cases[0].scene!r}" if len(scenes) < 2 else None


def next_in_another_scene(cases: Sequence[Case], number: int) -> Case:
    """The case after this number, cyclically, that is in another scene, of whichever data set; there must be one."""
    scene = cases[number].scene
    return next(case for case in (*cases[number + 1 :], *cases[:number]) if case.scene != scene)


def move_cameras(cameras: Cameras, motion: Tensor) -> Cameras:
    """The cameras after a rigid motion ``[4, 4]`` of the world."""
    return replace(cameras, world_from_camera=motion @ cameras.world_from_camera)
