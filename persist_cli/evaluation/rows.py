"""Rows of the table: what each of them gives for a clip."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from persist_cli.checkpoints import Checkpoint, load_adapter
from persist_cli.evaluation.revisits import RevisitClip
from persist_cli.memorizing.recall import MemoryMaker, collate
from persist_cli.rollout.world_model import clip_seed
from persist_cli.trajectories.clips import ClipSample
from persist_cli.world.backbone import Backbone, Clips, Sampling
from persist_cli.world.errors import CheckpointError

PLAIN = "stage1"  # the row of the base without any adapter


@dataclass(frozen=True)
class Row(ABC):
    """One row.

    Args:
        name: in the table.
        base: the checkpoint whose backbone it needs.
    """

    name: str
    base: Checkpoint

    random = False  # whether another seed gives another result

    @abstractmethod
    def prepare(self, backbone: Backbone) -> None:
        """Make the backbone ready for this row."""

    @abstractmethod
    def frames(self, backbone: Backbone, clips: Sequence[RevisitClip], seeds: Sequence[int]) -> tuple[Tensor, Tensor]:
        """RGB uint8 and depth in metres of every frame of the clips."""


class CopyRow(Row):
    """The clip's first frame, repeated: what a model must beat."""

    def prepare(self, backbone: Backbone) -> None:
        """Nothing to do."""

    def frames(self, backbone: Backbone, clips: Sequence[RevisitClip], seeds: Sequence[int]) -> tuple[Tensor, Tensor]:
        """The first frame of each clip as often as it has frames."""
        rgb = torch.stack([clip.observations.rgb[:1].expand_as(clip.observations.rgb) for clip in clips])
        depth = torch.stack([clip.observations.depth[:1].expand_as(clip.observations.depth) for clip in clips])
        return rgb, depth


class CodecRow(Row):
    """Ground truth after the codec: the ceiling of what the model can give."""

    def prepare(self, backbone: Backbone) -> None:
        """Nothing to do."""

    def frames(self, backbone: Backbone, clips: Sequence[RevisitClip], seeds: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Encoded and decoded ground truth."""
        return backbone.reconstruct(to_batch(clips, seeds, None, 0))


@dataclass(frozen=True)
class ModelRow(Row):
    """The model with one memory adapter, or with none.

    Args:
        checkpoint: that has the adapter.
        adapter: its name; ``None`` is plain stage 1.
        sampling: how clips are drawn.
        maker: of its memory.
    """

    checkpoint: Checkpoint
    adapter: str | None
    sampling: Sampling
    maker: MemoryMaker | None

    random = True

    def prepare(self, backbone: Backbone) -> None:
        """Load the adapter."""
        load_adapter(backbone, self.checkpoint, self.adapter)
        backbone.to("cuda" if torch.cuda.is_available() else "cpu").eval()

    def frames(self, backbone: Backbone, clips: Sequence[RevisitClip], seeds: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Clips generated from the first frame, with a memory of what came before."""
        return backbone.generate(to_batch(clips, seeds, self.maker, backbone.token_budget), self.sampling)


def make_rows(checkpoints: Sequence[Checkpoint], memories: Sequence[str], sampling: Sampling) -> list[Row]:
    """A row for each memory and checkpoint that has it, then the copy and the codec of each base.

    Raises:
        CheckpointError: when no checkpoint has a memory.
    """
    rows: list[Row] = []
    for memory in memories:
        owners = [each for each in checkpoints if memory == PLAIN or memory in each.adapters]
        if memory == PLAIN:
            owners = list({each.fingerprint: each for each in owners}.values())
        if not owners:
            known = sorted({name for each in checkpoints for name in each.adapters})
            raise CheckpointError(
                f"no checkpoint has a memory adapter {memory!r}; there are: {', '.join(known) or 'none'}"
            )
        for owner in owners:
            adapter = None if memory == PLAIN else memory
            maker = MemoryMaker.of(owner.memory_choice(memory)) if adapter else None
            name = memory if len(owners) == 1 else f"{memory} ({owner.name})"
            rows.append(ModelRow(name, owner, owner, adapter, sampling, maker))
    bases = list({each.fingerprint: each for each in checkpoints}.values())
    for base in bases:
        suffix = "" if len(bases) == 1 else f" ({base.name})"
        rows += [CopyRow(f"copy of the first frame{suffix}", base), CodecRow(f"codec reconstruction{suffix}", base)]
    return rows


def to_batch(clips: Sequence[RevisitClip], seeds: Sequence[int], maker: MemoryMaker | None, budget: int) -> Clips:
    """A batch of clips, with tokens where a memory is made."""
    samples = [
        ClipSample(clip.observations, clip.interactions, clip.context, clip.trajectory.info, seed)
        for clip, seed in zip(clips, seeds, strict=True)
    ]
    return collate(samples, maker, budget)


def row_seeds(seed: int, first: int, count: int) -> list[int]:
    """Noise seeds of the clips number ``first`` and on: the same for every row, so that rows are paired."""
    return [clip_seed(seed, first + number) for number in range(count)]
