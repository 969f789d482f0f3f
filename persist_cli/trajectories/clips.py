"""Clips of trajectories for training: sample number n is the same whoever asks, whenever."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from torch.utils.data import BatchSampler, Dataset

from persist_cli.trajectories.store import Store
from persist_cli.world.actions import ActionVocabulary
from persist_cli.world.backbone import Interactions
from persist_cli.world.errors import DataError
from persist_cli.world.observations import Observations, TrajectoryInfo


@dataclass(frozen=True)
class ClipSample:
    """One clip with what came before it.

    Args:
        observations: the clip's frames.
        interactions: what the agent did to the world in each step of the clip.
        context: earlier frames of the same trajectory, the clip's first one included; ``None`` when not asked for.
        info: of the trajectory.
        seed: for everything random about the sample.
    """

    observations: Observations
    interactions: Interactions
    context: Observations | None
    info: TrajectoryInfo
    seed: int


@dataclass(frozen=True)
class ClipPlan:
    """Which clips to draw.

    Args:
        frames: frames a clip.
        strides: one is drawn for each clip, among those that fit the trajectory.
        context_frames: most earlier frames to give along; 0 gives none.
        seed: of the draws.
        image_size: height and width that the frames must have.
    """

    frames: int
    strides: tuple[int, ...]
    context_frames: int
    seed: int
    image_size: tuple[int, int]


class ClipDataset(Dataset[ClipSample]):
    """Endless clips of a data set; item n depends on the seed and n only.

    Args:
        folder: of the data set.
        plan: which clips.
    """

    def __init__(self, folder: Path, plan: ClipPlan) -> None:
        self.plan = plan
        store = Store(folder)
        self.files = [file for file in store if len(file) > (plan.frames - 1) * min(plan.strides)]
        if not self.files:
            longest = max(len(file) for file in store)
            needed = (plan.frames - 1) * min(plan.strides) + 1
            raise DataError(f"{folder}: a clip needs {needed} frames, the longest trajectory has {longest}")
        for file in self.files:
            check_size(file.info, plan.image_size, f"{folder}#{file.name}")

    def __getitem__(self, number: int) -> ClipSample:
        random = np.random.default_rng((self.plan.seed, number))
        file = self.files[int(random.integers(len(self.files)))]
        steps = self.plan.frames - 1
        stride = int(random.choice([stride for stride in self.plan.strides if steps * stride < len(file)]))
        start = int(random.integers(len(file) - steps * stride))
        frames = slice(start, start + steps * stride + 1, stride)
        context = None
        if self.plan.context_frames:
            context = file.read(self._context_frames(start, random)).observations
        return ClipSample(
            observations=file.read(frames).observations,
            interactions=strided_interactions(file.actions()[start : frames.stop - 1], stride, file.info.vocabulary),
            context=context,
            info=file.info,
            seed=int(random.integers(2**31)),
        )

    def _context_frames(self, start: int, random: np.random.Generator) -> list[int]:
        """The clip's first frame and a random choice of those before it, in order."""
        count = min(start, self.plan.context_frames - 1)
        earlier = random.permutation(start)[:count]
        return [*sorted(int(frame) for frame in earlier), start]


class SharedBatches(BatchSampler):
    """This process's micro-batches of sample numbers, from any step on; together the processes see all numbers.

    Args:
        first_step: optimizer step to begin with.
        last_step: optimizer step to stop before.
        batch: samples a step, over all processes and micro-batches.
        accumulation: micro-batches a step.
        process: number of this process.
        processes: how many there are.
    """

    def __init__(
        self, first_step: int, last_step: int, batch: int, accumulation: int, process: int, processes: int
    ) -> None:
        if batch % (accumulation * processes):
            raise DataError(
                f"training.batch {batch} cannot be shared by {processes} processes with {accumulation} micro-batches"
            )
        self.first_step, self.last_step, self.batch = first_step, last_step, batch
        self.accumulation, self.process, self.processes = accumulation, process, processes

    def __len__(self) -> int:
        return (self.last_step - self.first_step) * self.accumulation

    def __iter__(self) -> Iterator[list[int]]:
        micro = self.batch // (self.accumulation * self.processes)
        for step in range(self.first_step, self.last_step):
            for part in range(self.accumulation):
                first = step * self.batch + (part * self.processes + self.process) * micro
                yield list(range(first, first + micro))


def strided_interactions(actions: Sequence[str | None], stride: int, vocabulary: ActionVocabulary) -> Interactions:
    """For each step of ``stride`` frames the first interaction that happened in it, if one did."""
    done = interactions_of(actions, vocabulary)
    steps = (done[first : first + stride] for first in range(0, len(done), stride))
    return tuple(next((name for name in step if name is not None), None) for step in steps)


def interactions_of(actions: Sequence[str | None], vocabulary: ActionVocabulary) -> Interactions:
    """What of the actions changes the world rather than the camera."""
    return tuple(name if name is not None and vocabulary[name].interaction else None for name in actions)


def check_size(info: TrajectoryInfo, image_size: tuple[int, int], where: str) -> None:
    """Raise ``DataError`` when images are not of the size that a model takes."""
    if (info.height, info.width) != image_size:
        height, width = image_size
        raise DataError(f"{where}: images are {info.height}x{info.width}, the model takes {height}x{width}")
