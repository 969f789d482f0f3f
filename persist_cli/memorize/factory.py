"""From a choice of memory to memories, and from clips to batches with their tokens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from persist_cli.api.backbone import Clips
from persist_cli.api.cameras import Cameras
from persist_cli.api.encoder import Encoder
from persist_cli.api.memory import FrameOfReference, Memory
from persist_cli.api.observations import TrajectoryInfo
from persist_cli.api.tokens import MemoryTokens
from persist_cli.data.clips import ClipSample
from persist_cli.io.settings import parse_settings
from persist_cli.plugins import load_plugin, make_encoder
from persist_cli.recipe import MemoryConfig

if TYPE_CHECKING:
    import torch
    from torch import Tensor


@dataclass(frozen=True)
class MemoryFactory:
    """Makes empty memories of one choice; plugin, settings and encoder are loaded once.

    Args:
        kind: the memory's class.
        settings: an instance of its settings type.
        encoder: that all of them share.
        device: where encoder and memories compute.
    """

    kind: type[Memory]
    settings: Any
    encoder: Encoder
    device: torch.device | str = "cpu"

    @staticmethod
    def of(choice: MemoryConfig, device: torch.device | str = "cpu") -> MemoryFactory:
        """The maker of this choice, computing there."""
        kind = load_plugin("memory", choice.name)
        settings = parse_settings(kind.settings_type, choice.settings, f"memory {choice.name!r}")
        encoder = make_encoder(choice.encoder, choice.encoder_settings).to(device)
        return MemoryFactory(kind, settings, encoder, device)

    def empty(self, info: TrajectoryInfo) -> Memory:
        """An empty memory in the frame of reference of a trajectory."""
        return self.kind(self.settings, self.encoder, FrameOfReference(info.scene, info.world_up))


def collate(samples: Sequence[ClipSample], tokens: MemoryTokens | None = None, latents: Tensor | None = None) -> Clips:
    """A batch of clips, with the batch's memory tokens and latents where there are any."""
    import torch

    cameras = [sample.observations.cameras for sample in samples]
    return Clips(
        rgb=torch.stack([sample.observations.rgb for sample in samples]),
        depth=torch.stack([sample.observations.depth for sample in samples]),
        cameras=Cameras(
            torch.stack([each.world_from_camera for each in cameras]),
            torch.stack([each.intrinsics for each in cameras]),
            cameras[0].height,
            cameras[0].width,
        ),
        interactions=[sample.interactions for sample in samples],
        tokens=tokens,
        seeds=[sample.seed for sample in samples],
        latents=latents,
    )


def recall_all(samples: Sequence[ClipSample], maker: MemoryFactory | None, budget: int) -> MemoryTokens | None:
    """What each sample's own memory says to its clip, as a batch; ``None`` without a maker."""
    if maker is None:
        return None
    return MemoryTokens.stack([recall(sample, maker, budget) for sample in samples])


def recall(sample: ClipSample, maker: MemoryFactory, budget: int) -> MemoryTokens:
    """What a memory of the sample's context says to the clip's cameras."""
    memory = maker.empty(sample.info)
    if sample.context is not None:
        memory.write(sample.context.to(maker.device))
    return memory.read(sample.observations.cameras, budget).to(maker.device)
