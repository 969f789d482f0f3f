"""Clips of trajectories for training: sample n depends on the seed and on n only, whichever process asks for it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch.utils.data import BatchSampler, Dataset

from persist_cli.api.actions import ActionVocabulary
from persist_cli.api.backbone import Clip, Interactions
from persist_cli.api.geometry import NEAR_DEGREES, NEAR_METRES, near_poses
from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.data.augment import Augmentation, View
from persist_cli.data.store import Store, TrajectoryFile
from persist_cli.errors import DataError, RecipeError


@dataclass(frozen=True)
class ClipPlan:
    """Settings of the clips that a ``ClipDataset`` draws.

    Args:
        frames: number of frames of a clip.
        strides: one is drawn for each clip, among those that fit the trajectory; a negative one plays it backwards.
        context_frames: largest number of earlier frames that come with a clip; 0 for no context.
        seed: seed of the draws.
        image_size: height and width in pixels that the frames must have.
        clips_per_trajectory: number of fixed clips that each trajectory offers; 0 draws from all possible clips.
        exclude_targets: share of the clips whose context has no frame near a frame that is to be predicted.
        exclude_metres: frames are near when their cameras are less than this apart, in metres, …
        exclude_degrees: … and turned by less than this angle.
        augmentation: random views of the clips.
    """

    frames: int
    strides: tuple[int, ...]
    context_frames: int
    seed: int
    image_size: tuple[int, int]
    clips_per_trajectory: int = 0
    exclude_targets: float = 0.0
    exclude_metres: float = NEAR_METRES
    exclude_degrees: float = NEAR_DEGREES
    augmentation: Augmentation = field(default_factory=Augmentation)


@dataclass(frozen=True)
class ClipFrames:
    """Frame numbers of one sample, drawn before anything of it is read.

    Args:
        file: the trajectory.
        frames: numbers of the clip's frames.
        context: numbers of the context's frames; empty when the plan has no context.
        seed: seed of everything random about the sample.
        view: how images and cameras are changed; ``None`` for not at all.
    """

    file: TrajectoryFile
    frames: range
    context: tuple[int, ...]
    seed: int
    view: View | None = None


@dataclass(frozen=True)
class ClipSample:
    """One clip with the frames that came before it.

    Args:
        clip: its images may have been left unread, its cameras are always there.
        context: earlier frames of the same trajectory and the clip's first one; ``None`` when left unread.
        info: what holds for every frame of the trajectory.
    """

    clip: Clip
    context: Observations | None
    info: TrajectoryInfo


class ClipDataset(Dataset[ClipSample]):
    """Endless clips of some data sets; sample n depends on the seed and on n only.

    Args:
        folders: folders of the data sets; their order matters for which clip is sample n.
        plan: settings of the clips.

    Raises:
        DataError: when no trajectory is long enough, or images are not of the plan's size.
    """

    def __init__(self, folders: Sequence[Path], plan: ClipPlan) -> None:
        self.plan = plan
        store = [file for folder in folders for file in Store(folder)]
        shortest = min(map(abs, plan.strides))
        self.files = [file for file in store if len(file) > (plan.frames - 1) * shortest]
        if not self.files:
            longest = max(len(file) for file in store)
            needed = (plan.frames - 1) * shortest + 1
            where = " and ".join(map(str, folders))
            raise DataError(f"{where}: a clip needs {needed} frames, the longest trajectory has {longest}")
        for file in self.files:
            check_size(file.info, plan.image_size, f"{file.path.parent}#{file.name}", plan.augmentation.crop < 1)

    def __getitem__(self, number: int) -> ClipSample:
        return self.read(self.choose(number))

    def choose(self, number: int) -> ClipFrames:
        """The frame numbers of sample ``number``, without reading images."""
        random = np.random.default_rng((self.plan.seed, number))
        place = int(random.integers(len(self.files)))
        file = self.files[place]
        if not self.plan.clips_per_trajectory:
            frames, context, view = self._draw(file, random)
            return ClipFrames(file, frames, context, int(random.integers(2**31)), view)
        clip = int(random.integers(self.plan.clips_per_trajectory))
        # plus one: numpy reads missing numbers as zeros, and (seed, place) is a sample's own
        frames, context, view = self._draw(file, np.random.default_rng((self.plan.seed, place, clip + 1)))
        return ClipFrames(file, frames, context, int(random.integers(2**31)), view)

    def read(self, choice: ClipFrames, images: bool = True, context: bool = True) -> ClipSample:
        """The sample with these frame numbers.

        Args:
            choice: frame numbers, as ``choose`` gives them.
            images: false leaves the clip's images unread and gives its cameras only.
            context: false leaves the context unread.
        """
        file, frames, view = choice.file, choice.frames, choice.view
        actions = file.actions()[frames[0] : frames[-1]]  # none backwards: what was done to the world is not undone
        interactions = strided_interactions(actions, abs(frames.step), file.info.vocabulary)
        context_frames = choice.context if context else ()
        observations = file.read(list(frames)).observations if images else cameras_only(file, frames)
        earlier = file.read(context_frames).observations if context_frames else None
        if view is not None:
            observations = view.observations(observations, file.info.world_up)
            earlier = None if earlier is None else view.observations(earlier, file.info.world_up)
        return ClipSample(
            clip=Clip(observations, interactions or (None,) * (len(frames) - 1), choice.seed),
            context=earlier,
            info=file.info,
        )

    def _draw(self, file: TrajectoryFile, random: np.random.Generator) -> tuple[range, tuple[int, ...], View | None]:
        """Frame numbers of a random clip and of its context, and the view of both."""
        steps = self.plan.frames - 1
        stride = int(random.choice([stride for stride in self.plan.strides if steps * abs(stride) < len(file)]))
        start = int(random.integers(len(file) - steps * abs(stride)))
        frames = range(start, start + steps * abs(stride) + 1, abs(stride))[:: 1 if stride > 0 else -1]
        context = tuple(self._context_frames(file, frames, random)) if self.plan.context_frames else ()
        return frames, context, self.plan.augmentation.draw(file.info, self.plan.image_size, random)

    def _context_frames(self, file: TrajectoryFile, frames: range, random: np.random.Generator) -> list[int]:
        """The clip's first frame and a random choice of those before it, in order."""
        start, plan = frames[0], self.plan
        earlier = np.arange(start)
        if plan.exclude_targets and random.random() < plan.exclude_targets:
            poses = file.poses()
            near = near_poses(poses[:start], poses[list(frames[1:])], plan.exclude_metres, plan.exclude_degrees)
            earlier = earlier[~near.any(dim=1).numpy()]
        chosen = random.permutation(earlier)[: plan.context_frames - 1]
        return [*sorted(int(frame) for frame in chosen), start]


class DistributedBatches(BatchSampler):
    """Sample numbers of the micro-batches of one process; together the processes read every number once.

    Args:
        first_step: optimizer step to begin with.
        last_step: optimizer step to stop before.
        batch: samples of an optimizer step, over all processes and micro-batches.
        accumulation: number of micro-batches of an optimizer step.
        process: number of this process.
        processes: number of processes.

    Raises:
        RecipeError: when the batch cannot be divided among them.
    """

    def __init__(
        self, first_step: int, last_step: int, batch: int, accumulation: int, process: int, processes: int
    ) -> None:
        check_batch_division(batch, accumulation, processes)
        self.first_step, self.last_step, self.batch = first_step, last_step, batch
        self.accumulation, self.process, self.processes = accumulation, process, processes

    def __len__(self) -> int:
        return (self.last_step - self.first_step) * self.accumulation

    def __iter__(self) -> Iterator[list[int]]:
        size = self.batch // (self.accumulation * self.processes)
        for step in range(self.first_step, self.last_step):
            for micro_batch in range(self.accumulation):
                first = step * self.batch + (micro_batch * self.processes + self.process) * size
                yield list(range(first, first + size))


def check_batch_division(batch: int, accumulation: int, processes: int) -> None:
    """Raise ``RecipeError`` unless every process gets micro-batches of one size.

    Args:
        batch: samples of an optimizer step.
        accumulation: number of micro-batches of an optimizer step.
        processes: number of processes that share each micro-batch.
    """
    if batch % (accumulation * processes) == 0:
        return
    share = batch // processes
    if batch % processes:
        advice = f"training.batch={max(1, share) * processes} training.accumulation={max(1, share)}"
    else:
        most = max(parts for parts in range(1, min(accumulation, share) + 1) if share % parts == 0)
        advice = f"training.accumulation={most}"
    raise RecipeError(
        f"training.batch {batch} cannot be shared by {processes} processes with {accumulation} micro-batches; "
        f"give {advice}"
    )


def check_size(info: TrajectoryInfo, image_size: tuple[int, int], where: str, crops: bool = False) -> None:
    """Raise ``DataError`` when images are not of the size that a model takes; where it crops, they may be larger."""
    height, width = image_size
    if crops and info.height >= height and info.width >= width:
        return
    if (info.height, info.width) != image_size:
        raise DataError(
            f"{where}: images are {info.height}x{info.width}, the model takes {height}x{width}; collect "
            f"or import them with --size {height}x{width}, or take a model of theirs (finetune: "
            f"backbone.settings.height={info.height} backbone.settings.width={info.width})"
        )


def interactions_of(actions: Sequence[str | None], vocabulary: ActionVocabulary) -> Interactions:
    """The name of each action that changes the world, ``None`` for those that only move the camera."""
    return tuple(name if name is not None and vocabulary[name].interaction else None for name in actions)


def strided_interactions(actions: Sequence[str | None], stride: int, vocabulary: ActionVocabulary) -> Interactions:
    """For each step of ``stride`` frames the first interaction in it, ``None`` for a step without one."""
    interactions = interactions_of(actions, vocabulary)
    steps = (interactions[first : first + stride] for first in range(0, len(interactions), stride))
    return tuple(next((name for name in step if name is not None), None) for step in steps)


def cameras_only(file: TrajectoryFile, frames: Sequence[int]) -> Observations:
    """Observations with the cameras of some frames, and with rgb and depth of no frames."""
    height, width = file.info.height, file.info.width
    rgb, depth = torch.zeros(0, height, width, 3, dtype=torch.uint8), torch.zeros(0, height, width)
    return Observations(rgb, depth, file.cameras(frames))
