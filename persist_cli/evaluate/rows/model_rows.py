"""Rows of a model: with a memory, with an intervention in its memory, or without one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from persist_cli.api.backbone import Backbone, Sampling
from persist_cli.api.cameras import Cameras
from persist_cli.api.checkpoint import Checkpoint
from persist_cli.api.inference import InferenceOptions
from persist_cli.api.memory import Memory
from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.checkpoints.load import load_adapter
from persist_cli.evaluate.cases import CaseFrames
from persist_cli.evaluate.rows.interventions import MemoryIntervention, Unmodified
from persist_cli.evaluate.rows.row import Row
from persist_cli.memorize.factory import MemoryFactory, as_scene
from persist_cli.rollout.world_model import Agent, WorldModel

NO_MEMORY = "none"  # name of the memory that never gives a token, so that no intervention can change anything

DISTANCE = 2.5  # metres, at which the resolution of a memory is told

NOTHING = (
    "which reads nothing: what it adds to stage 1 are learned tokens, the same in every clip; without them, as in the "
    "packaged model, it equals stage 1 to the bit"
)


@dataclass(frozen=True)
class RowMemory:
    """The memory of a model's row.

    Args:
        factory: makes an empty memory for each clip; ``None`` for a row without a memory.
        intervention: says what is written into the memory.
        writes: whether the protocol writes the model's own output.
    """

    factory: MemoryFactory | None
    intervention: MemoryIntervention
    writes: bool


class ModelRow(Row):
    """The model with one memory adapter, or with none.

    Args:
        name: name in the table.
        checkpoint: checkpoint that has the adapter.
        adapter: name of the adapter; ``None`` is plain stage 1.
        sampling: sampling of the clips.
        row_memory: memory that the adapter reads.
    """

    random = True
    uses_model = True

    def __init__(
        self, name: str, checkpoint: Checkpoint, adapter: str | None, sampling: Sampling, row_memory: RowMemory
    ) -> None:
        super().__init__(name, checkpoint)
        self.checkpoint, self.adapter, self.sampling, self.row_memory = checkpoint, adapter, sampling, row_memory
        self.agents: list[Agent] = []
        self.own_sampling = False  # whether the other rows may be sampled in another way
        self.growth: list[list[int]] = []
        self.kind = "model" if isinstance(row_memory.intervention, Unmodified) else "memory control"

    @property
    def definition(self) -> str:
        """A few words with the checkpoint, the adapter, the content of the memory, and sampling of its own."""
        return f"{self.model}; {self.sampling.words}" if self.own_sampling else self.model

    @property
    def model(self) -> str:
        """A few words with the checkpoint, the adapter and the content of the memory."""
        if self.adapter is None:
            return f"{self.checkpoint.name} without an adapter (stage 1)"
        if self.adapter == NO_MEMORY:
            return f"{self.checkpoint.name} with the adapter {NO_MEMORY!r}, {NOTHING}"
        return f"{self.checkpoint.name} with the adapter {self.adapter!r}, {self.row_memory.intervention.definition}"

    @property
    def truth(self) -> str:
        """What of the truth model and memory are given."""
        given = f"the first frame {'with' if self.has_depth else 'without'} its depth, and the true cameras"
        factory, intervention = self.row_memory.factory, self.row_memory.intervention
        if factory is None or self.adapter == NO_MEMORY:
            return given
        holds = intervention.holds
        if self.row_memory.writes and intervention.writes:
            holds = "its own frames"
        return f"{given}; its memory holds {holds} at {intervention.poses} poses"

    def prepare(self, backbone: Backbone, placement: InferenceOptions) -> None:
        """Load the adapter into the backbone and make it ready."""
        load_adapter(backbone, self.checkpoint, self.adapter)
        super().prepare(backbone, placement)

    def videos(self, backbone: Backbone, clips: Sequence[CaseFrames], seeds: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Roll out each clip from its first frame along its cameras."""
        agents = [self.agent(clip, seed) for clip, seed in zip(clips, seeds, strict=True)]
        self.agents = agents
        model = WorldModel(backbone, agents, self.sampling)
        model.reset([clip.observations[:1] for clip in clips], [clip.info for clip in clips])
        cameras = [clip.observations.cameras[1:] for clip in clips]
        parts = [[clip.observations[:1] for clip in clips]]
        self.growth = []
        for frames in model.imagine(cameras, [clip.interactions for clip in clips]):
            parts.append(frames)
            if self.row_memory.writes:
                self.growth.append([0 if one.memory is None else one.memory.figures().cells for one in agents])
        videos = [Observations.concatenate(frames) for frames in zip(*parts, strict=True)]
        return torch.stack([video.rgb for video in videos]), torch.stack([video.depth for video in videos])

    def reads(self) -> Float[Tensor, "clip 2"] | None:
        """Mean tokens and bytes of the reads for each clip; ``None`` without a memory."""
        if not all(agent.reads for agent in self.agents):
            return None
        return torch.stack([torch.tensor(agent.reads, dtype=torch.float64).mean(0) for agent in self.agents])

    def memory_json(self, info: TrajectoryInfo) -> dict[str, Any] | None:
        """Resolution at ``DISTANCE`` and whether depth is read, as JSON values."""
        if self.row_memory.factory is None:
            return None
        memory = self.row_memory.factory.empty(info)
        pose, matrix = torch.eye(4, dtype=torch.float64)[None], torch.from_numpy(info.intrinsics)[None]
        resolution = memory.resolution(Cameras(pose, matrix, info.height, info.width), DISTANCE)
        return {"resolution": resolution, "distance": DISTANCE, "reads_depth": memory.reads_depth}

    def cells(self) -> Int64[Tensor, "clip step"] | None:
        """Cells of each clip's memory after every predicted clip; ``None`` where nothing is written."""
        if self.row_memory.factory is None or not self.row_memory.writes:
            return None
        return torch.tensor(self.growth).T.contiguous()

    def agent(self, clip: CaseFrames, seed: int) -> Agent:
        """An agent that holds the clip's memory, before it is placed at the first frame."""
        intervention = self.row_memory.intervention
        disturb = intervention.disturber(clip, seed)
        return Agent(self.memory(clip, disturb), seed, self.row_memory.writes and intervention.writes, disturb)

    def memory(self, clip: CaseFrames, disturb: Callable[[Observations], Observations]) -> Memory | None:
        """The memory as it is before the clip begins."""
        if self.row_memory.factory is None:
            return None
        memory = self.row_memory.factory.empty(clip.info)
        context = self.row_memory.intervention.context(clip)
        if context is not None:
            memory.memorize(disturb(context))
        cells = self.row_memory.intervention.cells(clip)
        if cells is not None:
            as_scene(memory).add(cells)
        return memory
