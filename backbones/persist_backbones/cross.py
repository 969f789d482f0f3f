"""``cross``: the paper's form, one set of tokens with positions in metres."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from persist_backbones.adapter import Adapter, AdapterSettings, PreparedMemory, VideoShape
from persist_backbones.memory_block import MemoryBlock, position_code
from persist_cli.world.cameras import Cameras, invert_rigid
from persist_cli.world.geometry import transform
from persist_cli.world.tokens import MemoryTokens


class CrossAdapter(Adapter):
    """The paper's form: features with a position code, cross-attended after transformer blocks."""

    def __init__(self, channels: int, settings: AdapterSettings, video: VideoShape) -> None:
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
        return PreparedMemory(hidden * tokens.mask[..., None], tokens.mask)

    def after_block(
        self, layer: int, video: Tensor, memory: PreparedMemory, camera: Tensor, time: Tensor
    ) -> Float[Tensor, "batch token channel"]:
        """The memory block of this layer, where one stands."""
        if str(layer) not in self.blocks:
            return video
        block: MemoryBlock = self.blocks[str(layer)]  # type: ignore[assignment]
        return block(video, memory.tokens, memory.mask, camera, time)  # type: ignore[no-any-return]


def memory_blocks(settings: AdapterSettings, video: VideoShape, query_channels: int) -> nn.ModuleDict:
    """The paper's memory block after every n-th transformer block, by the layer's number.

    Args:
        settings: sizes.
        video: the model they stand in.
        query_channels: of what is concatenated to the hidden states in the query.
    """
    layers = range(settings.every - 1, video.layers, settings.every)
    sizes = (video.channels, query_channels, settings.width, settings.heads, settings.ff_factor, video.time_channels)
    return nn.ModuleDict({str(layer): MemoryBlock(*sizes) for layer in layers})
