"""Memory adapters: how tokens reach the video, one class a form (see ``forms``).

A form prepares the batch's tokens once and changes the hidden states before or after the blocks where it stands.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from pydantic import NonNegativeFloat, PositiveInt
from torch import Tensor, nn

from persist_cli.world.cameras import Cameras
from persist_cli.world.errors import CheckpointError
from persist_cli.world.tokens import MemoryTokens


@dataclass(frozen=True)
class AdapterSettings:
    """A memory adapter.

    Args:
        form: how tokens reach the video: ``cross``, the paper's cross-attention to positions in metres;
            ``projected``, the same to positions in each latent frame's own cameras; ``canvas``, tokens drawn into
            each view and added.
        every: a memory block stands after every n-th transformer block; ``canvas`` is added before every n-th, the
            first included.
        width: channels of the tokens inside the blocks, or of the canvas at a video token.
        heads: attention heads (``cross`` and ``projected``).
        ff_factor: hidden width of the feed-forward over the video's; 0 leaves it out (``canvas`` alone).
        frequencies: of the position code, for each axis (``cross`` and ``projected``).
        positions: ``relative`` to the first camera of the clip, or ``absolute`` as in the paper (``cross`` alone).
        canvas_channels: features of a token as drawn (``canvas``).
        canvas_scale: pixels of the canvas along the edge of a latent pixel (``canvas``).
        token_size: edge in metres of what a token stands for (``canvas``); 0 draws points.
        splat_pixels: most canvas pixels along the edge of a drawn token, odd (``canvas``); 1 draws points.
        token_budget: most tokens read for a clip.
        dropout: part of the training samples that see no memory, for guidance over memory.
    """

    form: str = "cross"
    every: PositiveInt = 1
    width: PositiveInt = 128
    heads: PositiveInt = 4
    ff_factor: float = 2.0
    frequencies: PositiveInt = 10
    positions: Literal["relative", "absolute"] = "relative"
    canvas_channels: PositiveInt = 32
    canvas_scale: PositiveInt = 1
    token_size: NonNegativeFloat = 0.25
    splat_pixels: PositiveInt = 5
    token_budget: int = 256
    dropout: float = 0.1


@dataclass(frozen=True)
class VideoShape:
    """What an adapter must know of the video model.

    Args:
        channels: of the hidden states.
        camera_channels: of the camera embedding at each token.
        time_channels: of the time embedding.
        layers: transformer blocks.
        patch: latent pixels along the edge of a video token.
        spatial: compression of the codec in height and width.
        temporal: compression of the codec in time.
    """

    channels: int
    camera_channels: int
    time_channels: int
    layers: int
    patch: int
    spatial: int
    temporal: int


@dataclass(frozen=True)
class PreparedMemory:
    """Memory of a batch, embedded once for all blocks and denoising steps.

    Args:
        tokens: what the form's blocks take.
        mask: what of it there is; nothing behind it changes the video.
        places: position code of each video token, for forms whose queries have one.
    """

    tokens: Float[Tensor, "batch *group token width"]
    mask: Bool[Tensor, "batch *group token"]
    places: Float[Tensor, "video_token code"] | None = None

    def only(self, kept: Bool[Tensor, " batch"]) -> PreparedMemory:
        """The same batch in which all other samples see no memory."""
        kept = kept.reshape(-1, *[1] * (self.mask.ndim - 1))
        return dataclasses.replace(self, mask=self.mask & kept)

    def emptied(self) -> PreparedMemory:
        """The same batch with every token behind the mask."""
        return dataclasses.replace(self, mask=torch.zeros_like(self.mask))


class Adapter(nn.Module, ABC):
    """A form of memory adapter.

    Args:
        channels: of the memory's features.
        settings: sizes.
        video: the model it stands in.
    """

    def __init__(self, channels: int, settings: AdapterSettings, video: VideoShape) -> None:
        super().__init__()
        self.channels = channels
        self.settings = settings
        self.video = video

    @abstractmethod
    def prepare(self, tokens: MemoryTokens, cameras: Cameras) -> PreparedMemory:
        """Embed the tokens of a batch for the clip that the cameras look at."""

    def before_block(self, layer: int, video: Tensor, memory: PreparedMemory) -> Tensor:
        """The hidden states ``[batch, token, channel]`` before transformer block ``layer``; unchanged by default."""
        return video

    def after_block(
        self, layer: int, video: Tensor, memory: PreparedMemory, camera: Tensor, time: Tensor
    ) -> Float[Tensor, "batch token channel"]:
        """The hidden states after transformer block ``layer``; unchanged by default."""
        return video


def refuse_absolute(settings: AdapterSettings) -> None:
    """Raise ``CheckpointError`` when a form that places tokens by cameras alone is asked for absolute positions."""
    if settings.positions == "absolute":
        raise CheckpointError(f"adapter form {settings.form!r} has no absolute positions; only 'cross' has")
