"""From a choice of memory to memories, and from clips to batches with their tokens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from persist_cli.recipe import MemoryChoice
from persist_cli.registry import load_plugin, make_encoder
from persist_cli.trajectories.clips import ClipSample
from persist_cli.world.backbone import Clips
from persist_cli.world.cameras import Cameras
from persist_cli.world.encoder import Encoder
from persist_cli.world.memory import FrameOfReference, Memory
from persist_cli.world.observations import TrajectoryInfo
from persist_cli.world.settings import parse_settings
from persist_cli.world.tokens import MemoryTokens


@dataclass(frozen=True)
class MemoryMaker:
    """Makes empty memories of one choice; plugin, settings and encoder are loaded once.

    Args:
        kind: the memory's class.
        settings: an instance of its settings type.
        encoder: that all of them share.
    """

    kind: type[Memory]
    settings: Any
    encoder: Encoder

    @staticmethod
    def of(choice: MemoryChoice) -> MemoryMaker:
        """The maker of this choice."""
        kind = load_plugin("memory", choice.name)
        settings = parse_settings(kind.settings_type, choice.settings, f"memory {choice.name!r}")
        return MemoryMaker(kind, settings, make_encoder(choice.encoder, choice.encoder_settings))

    def empty(self, info: TrajectoryInfo) -> Memory:
        """An empty memory in the frame of reference of a trajectory."""
        return self.kind(self.settings, self.encoder, FrameOfReference(info.scene, info.world_up))


def collate(samples: Sequence[ClipSample], maker: MemoryMaker | None, budget: int) -> Clips:
    """A batch of clips; with a maker, each with the tokens that a memory of its context gives its cameras.

    Latents and tokens that samples bring along are taken; either all samples bring latents or none.
    """
    import torch

    tokens = None
    if maker is not None:
        known = [sample.tokens for sample in samples]
        tokens = MemoryTokens.stack(
            [
                recall(sample, maker, budget) if each is None else each
                for sample, each in zip(samples, known, strict=True)
            ]
        )
    latents = [sample.latents for sample in samples if sample.latents is not None]
    first = samples[0].observations.cameras
    return Clips(
        rgb=torch.stack([sample.observations.rgb for sample in samples]),
        depth=torch.stack([sample.observations.depth for sample in samples]),
        cameras=Cameras(
            torch.stack([sample.observations.cameras.world_from_camera for sample in samples]),
            torch.stack([sample.observations.cameras.intrinsics for sample in samples]),
            first.height,
            first.width,
        ),
        interactions=[sample.interactions for sample in samples],
        tokens=tokens,
        seeds=[sample.seed for sample in samples],
        latents=torch.stack(latents) if latents else None,
    )


def recall(sample: ClipSample, maker: MemoryMaker, budget: int) -> MemoryTokens:
    """What a memory of the sample's context says to the clip's cameras."""
    memory = maker.empty(sample.info)
    if sample.context is not None:
        memory.write(sample.context)
    return memory.read(sample.observations.cameras, budget)
