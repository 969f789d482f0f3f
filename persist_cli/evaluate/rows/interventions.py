"""What the memory of a row is made of: the truth, or what shows whether it is used."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from persist_cli.api.cameras import Cameras, invert_rigid
from persist_cli.api.observations import Observations
from persist_cli.errors import DataError
from persist_cli.evaluate.cases import Case, CaseFrames, read_case


class MemoryIntervention(ABC):
    """What is written into a row's memory; ``writes`` says whether the model's own output may follow."""

    name: ClassVar[str]
    writes: ClassVar[bool] = False

    @property
    @abstractmethod
    def definition(self) -> str:
        """What the memory holds."""

    @abstractmethod
    def context(self, clip: CaseFrames) -> Observations | None:
        """The frames that a clip's memory is made of before it begins."""

    def disturb(self, seen: Observations, draws: torch.Generator) -> Observations:
        """Frames as they come into the memory; as they are by default."""
        return seen


class Unmodified(MemoryIntervention):
    """The memory that the protocol says."""

    name = ""
    writes = True
    definition = "memory as the protocol says"

    def context(self, clip: CaseFrames) -> Observations | None:
        """The frames before the clip."""
        return clip.context


class Emptied(MemoryIntervention):
    """No memory at all."""

    name = "emptied"
    definition = "its memory is always empty"

    def context(self, clip: CaseFrames) -> Observations | None:
        """Nothing."""
        return None


class Oracle(MemoryIntervention):
    """A memory that has seen the future."""

    name = "oracle"
    definition = "its memory holds the true frames of the clip too"

    def context(self, clip: CaseFrames) -> Observations | None:
        """The frames before the clip and those of the clip."""
        parts = [clip.observations] if clip.context is None else [clip.context, clip.observations]
        return Observations.concatenate(parts)


class Shuffled(MemoryIntervention):
    """The wrong memory.

    Args:
        cases: of the evaluation; a clip gets the memory of the next one in another scene.
    """

    name = "shuffled"
    definition = "its memory is that of the next clip in another scene, moved to where this clip begins"

    def __init__(self, cases: Sequence[Case]) -> None:
        self.partners = {case: partner(cases, number) for number, case in enumerate(cases)}

    def context(self, clip: CaseFrames) -> Observations | None:
        """The other clip's frames, in this clip's world: where it begins is where this one begins."""
        other = read_case(self.partners[clip.case])
        frames = other.context if other.context is not None else other.observations
        here, there = (each.observations.cameras.world_from_camera[0] for each in (clip, other))
        return replace(frames, cameras=moved(frames.cameras, here @ invert_rigid(there)))


@dataclass(frozen=True)
class NoisyPoses(MemoryIntervention):
    """A memory whose poses are wrong.

    Args:
        centimetres: standard deviation of the error along each axis.
        degrees: standard deviation of the error about each axis.
    """

    centimetres: float = 5.0
    degrees: float = 2.0
    name = "noisy poses"
    writes = True

    @property
    def definition(self) -> str:
        """With its figures."""
        return (
            f"every pose written to its memory is off by σ = {self.centimetres:g} cm along and {self.degrees:g}° about "
            "each camera axis"
        )

    def context(self, clip: CaseFrames) -> Observations | None:
        """The frames before the clip."""
        return clip.context

    def disturb(self, seen: Observations, draws: torch.Generator) -> Observations:
        """Each pose moved and turned by its own error."""
        errors = torch.randn(len(seen), 6, generator=draws, dtype=torch.float64)
        metres, radians = errors[:, :3] * self.centimetres / 100, errors[:, 3:] * math.radians(self.degrees)
        wrong = seen.cameras.world_from_camera @ small_motions(metres, radians)
        return replace(seen, cameras=replace(seen.cameras, world_from_camera=wrong))


def partner(cases: Sequence[Case], number: int) -> Case:
    """The next case, cyclically, in another scene.

    Raises:
        DataError: when all are in one scene.
    """
    own = (cases[number].data, cases[number].scene)
    for step in range(1, len(cases)):
        other = cases[(number + step) % len(cases)]
        if (other.data, other.scene) != own:
            return other
    raise DataError(
        f"the control 'shuffled' needs clips of two scenes, all are of {cases[number].scene!r}; "
        "leave it out of --controls or add scenes"
    )


def moved(cameras: Cameras, motion: Tensor) -> Cameras:
    """The cameras after a rigid motion of the world."""
    return replace(cameras, world_from_camera=motion @ cameras.world_from_camera)


def small_motions(translations: Tensor, rotations: Tensor) -> Tensor:
    """Rigid transforms of translations in metres and rotation vectors in radians, ``[frame, 4, 4]``."""
    skew = rotations.new_zeros(len(rotations), 3, 3)
    x, y, z = rotations.unbind(-1)
    skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0] = x, y, z
    motions = torch.eye(4, dtype=rotations.dtype).repeat(len(rotations), 1, 1)
    motions[:, :3, :3] = torch.linalg.matrix_exp(skew - skew.transpose(1, 2))
    motions[:, :3, 3] = translations
    return motions
