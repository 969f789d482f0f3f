"""The adapter ``cross``, the paper's own: every frame attends to one set of tokens with positions in metres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from persist_backbones.adapters.base import Adapter, PreparedMemory, VideoShape
from persist_backbones.adapters.memory_block import AttentionSettings, memory_blocks, position_code
from persist_cli.api.cameras import Cameras, invert_rigid
from persist_cli.api.geometry import transform
from persist_cli.api.tokens import MemoryTokens


@dataclass(frozen=True)
class CrossSettings(AttentionSettings):
    """Settings of the paper's cross-attention to tokens with positions in metres.

    Args:
        positions: ``relative`` to the first camera of the clip, or ``absolute`` in the world, as in the paper.
    """

    form: Literal["cross"] = "cross"
    positions: Literal["relative", "absolute"] = "relative"


class CrossAdapter(Adapter[PreparedMemory]):
    """The paper's form: the video cross-attends, after transformer blocks, to features with a position code."""

    settings_type = CrossSettings
    settings: CrossSettings

    def __init__(self, channels: int, settings: CrossSettings, video: VideoShape) -> None:
        super().__init__(channels, settings, video)
        self.embed = nn.Linear(channels + 6 * settings.frequencies, settings.width)
        self.blocks = memory_blocks(settings, video, video.camera_channels)

    def prepare(self, tokens: MemoryTokens, cameras: Cameras) -> PreparedMemory:
        """Concatenate the position code to the features and project them."""
        positions = tokens.positions
        if self.settings.positions == "relative":
            first_from_world = invert_rigid(cameras.world_from_camera[:, 0].double())
            positions = transform(first_from_world, positions)
        code = position_code(positions, self.settings.frequencies)
        hidden = self.embed(torch.cat([tokens.features, code], dim=-1).to(self.embed.weight.dtype))
        return self.with_learned(PreparedMemory(hidden * tokens.mask[..., None], tokens.mask))

    def after(
        self, block: nn.Module, video: Tensor, memory: PreparedMemory, camera: Tensor, time: Tensor
    ) -> Float[Tensor, "batch token channel"]:
        """Return the video after the memory block."""
        changed: Tensor = block(video, memory.tokens, memory.mask, camera, time)
        return changed
