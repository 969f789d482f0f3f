"""Memory adapters: how tokens reach the video, one class a form.

``cross`` is the paper's. ``FORMS`` is the seam for others: a form prepares the batch's tokens once and changes the
hidden states after the blocks where it stands.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from persist_backbones.memory_block import MemoryBlock, position_code
from persist_cli.world.cameras import Cameras, invert_rigid
from persist_cli.world.errors import CheckpointError
from persist_cli.world.geometry import transform
from persist_cli.world.tokens import MemoryTokens


@dataclass(frozen=True)
class AdapterSettings:
    """A memory adapter.

    Args:
        form: how tokens reach the video; ``cross`` is the paper's cross-attention.
        every: a memory block stands after every n-th transformer block.
        width: channels of the tokens inside the blocks.
        heads: attention heads.
        ff_factor: hidden width of the feed-forward over the video's.
        frequencies: of the position code, for each axis.
        positions: ``relative`` to the first camera of the clip, or ``absolute`` as in the paper.
        token_budget: most tokens read for a clip.
        dropout: part of the training samples that see no memory, for guidance over memory.
    """

    form: str = "cross"
    every: int = 1
    width: int = 128
    heads: int = 4
    ff_factor: float = 2.0
    frequencies: int = 10
    positions: Literal["relative", "absolute"] = "relative"
    token_budget: int = 256
    dropout: float = 0.1


@dataclass(frozen=True)
class VideoShape:
    """What an adapter must know of the transformer.

    Args:
        channels: of the hidden states.
        camera_channels: of the camera embedding at each token.
        time_channels: of the time embedding.
        layers: transformer blocks.
    """

    channels: int
    camera_channels: int
    time_channels: int
    layers: int


@dataclass(frozen=True)
class PreparedMemory:
    """Tokens of a batch, embedded once for all blocks and denoising steps."""

    tokens: Float[Tensor, "batch token width"]
    mask: Bool[Tensor, "batch token"]

    def emptied(self) -> PreparedMemory:
        """The same batch with every token behind the mask."""
        return PreparedMemory(self.tokens, torch.zeros_like(self.mask))


class Adapter(nn.Module, ABC):
    """A form of memory adapter.

    Args:
        channels: of the memory's features.
        settings: sizes.
        video: the transformer it stands in.
    """

    def __init__(self, channels: int, settings: AdapterSettings, video: VideoShape) -> None:
        super().__init__()
        self.channels = channels
        self.settings = settings

    @abstractmethod
    def prepare(self, tokens: MemoryTokens, cameras: Cameras) -> PreparedMemory:
        """Embed the tokens of a batch for the clip that the cameras look at."""

    @abstractmethod
    def after_block(
        self, layer: int, video: Tensor, memory: PreparedMemory, camera: Tensor, time: Tensor
    ) -> Float[Tensor, "batch token channel"]:
        """The hidden states after transformer block ``layer``."""


class CrossAdapter(Adapter):
    """The paper's form: features with a position code, cross-attended after transformer blocks."""

    def __init__(self, channels: int, settings: AdapterSettings, video: VideoShape) -> None:
        super().__init__(channels, settings, video)
        self.embed = nn.Linear(channels + 6 * settings.frequencies, settings.width)
        self.blocks = nn.ModuleDict(
            {
                str(layer): MemoryBlock(
                    video.channels, video.camera_channels, settings.width, settings.heads, settings.ff_factor,
                    video.time_channels,
                )
                for layer in range(settings.every - 1, video.layers, settings.every)
            }
        )  # fmt: skip

    def prepare(self, tokens: MemoryTokens, cameras: Cameras) -> PreparedMemory:
        """Concatenate the position code to the features and project them."""
        positions = tokens.positions
        if self.settings.positions == "relative":
            first_from_world = invert_rigid(cameras.world_from_camera[:, 0].double())
            positions = transform(first_from_world, positions)
        code = position_code(positions, self.settings.frequencies)
        hidden = self.embed(torch.cat([tokens.features, code], dim=-1))
        return PreparedMemory(hidden * tokens.mask[..., None], tokens.mask)

    def after_block(
        self, layer: int, video: Tensor, memory: PreparedMemory, camera: Tensor, time: Tensor
    ) -> Float[Tensor, "batch token channel"]:
        """The memory block of this layer, where one stands."""
        if str(layer) not in self.blocks:
            return video
        block: MemoryBlock = self.blocks[str(layer)]  # type: ignore[assignment]
        return block(video, memory.tokens, memory.mask, camera, time)  # type: ignore[no-any-return]


FORMS: dict[str, type[Adapter]] = {"cross": CrossAdapter}


def make_adapter(channels: int, settings: AdapterSettings, video: VideoShape) -> Adapter:
    """A fresh adapter of the form that the settings name.

    Raises:
        CheckpointError: for an unknown form.
    """
    if settings.form not in FORMS:
        raise CheckpointError(f"unknown adapter form {settings.form!r}; known: {', '.join(FORMS)}")
    return FORMS[settings.form](channels, settings, video)
