"""Rows of a model: with a memory adapter, with a disturbed memory, or with none."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from persist_cli.api.backbone import Backbone, Sampling
from persist_cli.api.checkpoint import Checkpoint
from persist_cli.api.inference import InferenceOptions
from persist_cli.api.memory import Memory
from persist_cli.api.observations import Observations
from persist_cli.checkpoints.load import load_adapter
from persist_cli.evaluate.cases import CaseFrames
from persist_cli.evaluate.rows.interventions import MemoryIntervention, Unmodified
from persist_cli.evaluate.rows.row import Row
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.rollout.world_model import Agent, WorldModel


@dataclass(frozen=True)
class RowMemory:
    """What a model row remembers with.

    Args:
        maker: of its memories; ``None`` without a memory.
        recall: what they are made of.
        writes: whether the protocol writes the model's own output.
    """

    maker: MemoryFactory | None
    recall: MemoryIntervention
    writes: bool


class ModelRow(Row):
    """The model with one memory adapter, or with none.

    Args:
        name: in the table.
        checkpoint: that has the adapter.
        adapter: its name; ``None`` is plain stage 1.
        sampling: how clips are drawn.
        row_memory: with which memory.
    """

    random = True
    uses_model = True

    def __init__(
        self,
        name: str,
        checkpoint: Checkpoint,
        adapter: str | None,
        sampling: Sampling,
        row_memory: RowMemory,
    ) -> None:
        super().__init__(name, checkpoint)
        self.checkpoint, self.adapter, self.sampling, self.row_memory = checkpoint, adapter, sampling, row_memory
        self.kind = "model" if isinstance(row_memory.recall, Unmodified) else "memory control"

    @property
    def definition(self) -> str:
        """Checkpoint, adapter and what the memory holds."""
        if self.adapter is None:
            return f"{self.checkpoint.name} without an adapter (stage 1)"
        return f"{self.checkpoint.name} with the adapter {self.adapter!r}, {self.row_memory.recall.definition}"

    def prepare(self, backbone: Backbone, placement: InferenceOptions) -> None:
        """Load the adapter."""
        load_adapter(backbone, self.checkpoint, self.adapter)
        super().prepare(backbone, placement)

    def videos(self, backbone: Backbone, clips: Sequence[CaseFrames], seeds: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Rollouts from each clip's first frame along its cameras."""
        agents = [self.agent(clip, seed) for clip, seed in zip(clips, seeds, strict=True)]
        model = WorldModel(backbone, agents, self.sampling)
        model.reset([clip.observations[:1] for clip in clips], [clip.info for clip in clips])
        cameras = [clip.observations.cameras[1:] for clip in clips]
        parts = [[clip.observations[:1] for clip in clips]]
        parts += model.imagine(cameras, [clip.interactions for clip in clips])
        videos = [Observations.concatenate(frames) for frames in zip(*parts, strict=True)]
        return torch.stack([video.rgb for video in videos]), torch.stack([video.depth for video in videos])

    def agent(self, clip: CaseFrames, seed: int) -> Agent:
        """An agent with the clip's memory."""
        intervention = self.row_memory.recall
        disturb = partial(intervention.disturb, draws=torch.Generator().manual_seed(seed))
        return Agent(self.memory(clip, disturb), seed, self.row_memory.writes and intervention.writes, disturb)

    def memory(self, clip: CaseFrames, disturb: Callable[[Observations], Observations]) -> Memory | None:
        """The clip's memory before it begins."""
        if self.row_memory.maker is None:
            return None
        memory = self.row_memory.maker.empty(clip.info)
        context = self.row_memory.recall.context(clip)
        if context is not None:
            memory.write(disturb(context))
        return memory
