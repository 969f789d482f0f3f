"""Clips of trajectories for training: sample n depends on the seed and on n only, whichever process asks for it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from random import Random

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import BatchSampler, Dataset

from persist_cli.api.actions import ActionVocabulary
from persist_cli.api.backbone import Clip, Interactions
from persist_cli.api.cells import CellGrid
from persist_cli.api.geometry import near_poses
from persist_cli.api.nearness import NEAR_DEGREES, NEAR_METRES
from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.data.augment import Augmentation, View
from persist_cli.data.store import Store, TrajectoryFile
from persist_cli.data.writing_noise import NO_ERRORS, WritingNoise
from persist_cli.errors import DataError, RecipeError


@dataclass(frozen=True, kw_only=True)
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
        own_writes: share of the samples that are chained: segments of a clip's length come before the clip, whose
            frames the model predicts itself.
        own_after: number of the first sample that may be chained.
        segments: number of segments of a chained sample, the clip included.
        noise: errors of the frames of contexts.
        true_cells: share of the samples that come with the true cells of their scene in the place of a context.
        lengths: of the clips in frames, one for each batch; empty for ``frames`` always.
        batch: number of samples that have one length.
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
    own_writes: float = 0.0
    own_after: int = 0
    segments: int = 2
    noise: WritingNoise = NO_ERRORS
    true_cells: float = 0.0
    lengths: tuple[int, ...] = ()
    batch: int = 1


@dataclass(frozen=True)
class ClipFrames:
    """Frame numbers of one sample, drawn before anything of it is read.

    Args:
        file: the trajectory.
        frames: numbers of the clip's frames.
        context: numbers of the context's frames; empty when the plan has no context.
        seed: seed of everything random about the sample but its frames and their errors.
        view: how images and cameras are changed; ``None`` for not at all.
        before: numbers of the frames of each segment before the clip; each ends where the next one begins.
        noise_seed: seed of the errors of the context's frames.
        true_cells: whether the true cells of the scene stand in the place of the context.
    """

    file: TrajectoryFile
    frames: range
    context: tuple[int, ...]
    seed: int
    view: View | None = None
    before: tuple[range, ...] = ()
    noise_seed: int = 0
    true_cells: bool = False

    def segments(self) -> tuple[ClipFrames, ...]:
        """The frame numbers of each segment before the clip, and of the clip, as samples of their own."""
        seeds = np.random.default_rng(self.seed).integers(2**31, size=len(self.before))
        parts = [replace(self, frames=part, seed=int(seed)) for part, seed in zip(self.before, seeds, strict=True)]
        return tuple(replace(part, context=(), before=()) for part in (*parts, self))


@dataclass(frozen=True)
class ClipSample:
    """One clip with the frames that came before it.

    Args:
        clip: its images may have been left unread, its cameras are always there.
        context: earlier frames of the same trajectory, the last of them the first frame of the clip or of the first
            segment before it; ``None`` when left unread.
        info: what holds for every frame of the trajectory.
        before: the segments before the clip, whose frames the model shall predict and write itself.
        remembered: tensors of a memory that stand for the context; ``None`` when there are none.
        cells: the true cells of the scene at the sample's first frame, which stand for the context; ``None`` where the
            context does, or when left unread.
    """

    clip: Clip
    context: Observations | None
    info: TrajectoryInfo
    before: tuple[Clip, ...] = ()
    remembered: dict[str, Tensor] | None = None
    cells: CellGrid | None = None


class ClipDataset(Dataset[ClipSample]):
    """Endless clips of some data sets; sample n depends on the seed and on n only.

    Args:
        folders: folders of the data sets; their order matters for which clip is sample n.
        plan: settings of the clips.

    Raises:
        DataError: when no trajectory is long enough, images are not of the plan's size, or one has no cells and some
            of its samples would take the true ones.
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
        self.shortest_chain = (plan.frames - 1) * plan.segments * shortest + 1
        if plan.own_writes and not any(len(file) >= self.shortest_chain for file in self.files):
            raise DataError(
                f"{' and '.join(map(str, folders))}: {plan.segments} segments of a clip need {self.shortest_chain} "
                f"frames, the longest trajectory has {max(map(len, self.files))}; set data.own_writes=0"
            )
        for file in self.files:
            check_size(file.info, plan.image_size, f"{file.path.parent}#{file.name}", plan.augmentation.crop < 1)
            if plan.true_cells and not file.has_cells:
                raise file.without_cells()

    def __getitem__(self, number: int) -> ClipSample:
        return self.read(self.choose(number))

    def choose(self, number: int) -> ClipFrames:
        """The frame numbers of sample ``number``, without reading images."""
        random = np.random.default_rng((self.plan.seed, number))
        place = int(random.integers(len(self.files)))
        file, plan = self.files[place], self.plan
        chained = bool(plan.own_writes) and random.random() < plan.own_writes and number >= plan.own_after
        segments = plan.segments if chained and len(file) >= self.shortest_chain else 1
        if not plan.clips_per_trajectory:
            frames = self._draw(file, random, segments)
        else:
            clip = int(random.integers(plan.clips_per_trajectory))
            # plus one: numpy reads missing numbers as zeros, and (seed, place) is a sample's own
            key = (plan.seed, place, clip + 1, *([segments] if segments > 1 else []))
            frames = self._draw(file, np.random.default_rng(key), segments)
        seed, whole = int(random.integers(2**31)), frames.frames
        length = clip_length(plan.lengths, plan.seed, number // plan.batch) if plan.lengths else len(whole)
        return replace(frames, frames=whole[:length], seed=seed)

    def read(self, choice: ClipFrames, images: bool = True, context: bool = True) -> ClipSample:
        """The sample with these frame numbers.

        Args:
            choice: frame numbers, as ``choose`` gives them.
            images: false leaves the clips' images unread and gives their cameras only.
            context: false leaves the context unread, and the cells that stand for it.
        """
        *before, clip = (self._clip(segment, images) for segment in choice.segments())
        if choice.true_cells:
            cells = choice.file.cells(choice.segments()[0].frames[0]) if context else None
            return ClipSample(clip, None, choice.file.info, tuple(before), cells=cells)
        seen = choice.file.read(choice.context).observations if context and choice.context else None
        if seen is not None and choice.view is not None:
            seen = choice.view.observations(seen, choice.file.info.world_up)
        if seen is not None and self.plan.noise:
            seen = self.plan.noise.disturb(seen, torch.Generator().manual_seed(choice.noise_seed))
        return ClipSample(clip, seen, choice.file.info, tuple(before))

    def _clip(self, choice: ClipFrames, images: bool) -> Clip:
        """The clip of these frames, without images where none are wanted."""
        file, frames = choice.file, choice.frames
        actions = file.actions()[frames[0] : frames[-1]]  # none backwards: what was done to the world is not undone
        interactions = strided_interactions(actions, abs(frames.step), file.info.vocabulary)
        observations = file.read(list(frames)).observations if images else cameras_only(file, frames)
        if choice.view is not None:
            observations = choice.view.observations(observations, file.info.world_up)
        return Clip(observations, interactions or (None,) * (len(frames) - 1), choice.seed)

    def _draw(self, file: TrajectoryFile, random: np.random.Generator, segments: int) -> ClipFrames:
        """Frame numbers of a random clip, of the segments before it and of its context, and their view; seed 0."""
        plan, length = self.plan, self.plan.frames - 1
        steps = length * segments
        stride = int(random.choice([stride for stride in self.plan.strides if steps * abs(stride) < len(file)]))
        start = int(random.integers(len(file) - steps * abs(stride)))
        frames = range(start, start + steps * abs(stride) + 1, abs(stride))[:: 1 if stride > 0 else -1]
        context = tuple(self._context_frames(file, frames, random)) if plan.context_frames else ()
        view = plan.augmentation.draw(file.info, plan.image_size, random)
        noise_seed = int(random.integers(2**31)) if context and plan.noise else 0
        *before, clip = (frames[first : first + length + 1] for first in range(0, steps, length))
        true_cells = bool(plan.true_cells) and random.random() < plan.true_cells
        return ClipFrames(file, clip, context, 0, view, tuple(before), noise_seed, true_cells)

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


def clip_length(lengths: Sequence[int], seed: int, step: int) -> int:
    """One of some lengths of clips, the same for all samples of a training step."""
    # a text as the seed: no other random numbers of a training begin like these
    return Random(f"clip_frames {seed} {step}").choice(lengths)


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
        check_batch_division(batch, accumulation, processes, begun=first_step > 0)
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


def check_batch_division(batch: int, accumulation: int, processes: int, begun: bool = False) -> None:
    """Raise ``RecipeError`` unless every process gets micro-batches of one size.

    Args:
        batch: samples of an optimizer step.
        accumulation: number of micro-batches of an optimizer step.
        processes: number of processes that share each micro-batch.
        begun: whether the run goes on, which keeps its batch.
    """
    if batch % (accumulation * processes) == 0:
        return
    share = batch // processes
    if batch % processes and begun:
        fewer = max(count for count in range(1, processes) if batch % count == 0)
        share, samples = batch // fewer, max(1, share // accumulation)  # no more at once than was asked for
        parts = min(parts for parts in range(1, share + 1) if share % parts == 0 and share // parts <= samples)
        advice = f"training.accumulation={parts} and launch {fewer} of them: a run that has begun keeps its batch"
    elif batch % processes:
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
