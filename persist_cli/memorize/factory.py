"""From the configuration of a memory to memories, and from training clips to clips with their tokens."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from persist_cli.api.backbone import Clip
from persist_cli.api.encoder import Encoder
from persist_cli.api.memory import FrameOfReference, Memory
from persist_cli.api.observations import TrajectoryInfo
from persist_cli.data.clips import ClipSample
from persist_cli.io.settings import parse_settings
from persist_cli.plugins import load_plugin, make_encoder
from persist_cli.recipe import MemoryConfig

if TYPE_CHECKING:
    import torch


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


def with_memory(sample: ClipSample, factory: MemoryFactory | None, budget: int) -> Clip:
    """A training clip with what a memory of its context says to its cameras; as it is without a factory."""
    if factory is None:
        return sample.clip
    memory = factory.empty(sample.info)
    if sample.context is not None:
        memory.write(sample.context.to(factory.device))
    tokens = memory.read(sample.clip.observations.cameras, budget).to(factory.device)
    return replace(sample.clip, tokens=tokens)
