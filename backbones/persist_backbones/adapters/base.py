"""Memory adapters: how tokens reach the video, one class a form (see ``forms``).

A form prepares the batch's tokens once, changes the hidden states before or after the blocks where it stands, and may
correct the prediction.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, ClassVar, Generic, Self, TypeVar

import torch
from jaxtyping import Bool, Float
from pydantic import Field, NonNegativeFloat, PositiveInt
from torch import Tensor, nn

from persist_cli.api.cameras import Cameras
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import CheckpointError

NEAR = 0.05  # metres in front of a camera; a token nearer than that is not in its picture


@dataclass(frozen=True)
class AdapterSettings:
    """What every form has.

    Args:
        form: one of ``FORMS``.
        every: a block of the adapter stands at every n-th transformer block.
        width: channels of the tokens inside the blocks, or of the canvas at a video token.
        ff_factor: hidden width of the feed-forward over the video's.
        token_budget: most tokens read for a clip.
        dropout: part of the training samples that see no memory, for guidance over memory.
    """

    form: str
    every: PositiveInt = 1
    width: PositiveInt = 128
    ff_factor: NonNegativeFloat = 2.0
    token_budget: PositiveInt = 256
    dropout: Annotated[float, Field(ge=0, le=1)] = 0.1


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
        inputs: channels of all that the model sees at a latent pixel.
        outputs: channels of its prediction.
        token_frames: latent frames that a video token stands for.
    """

    channels: int
    camera_channels: int
    time_channels: int
    layers: int
    patch: int
    spatial: int
    temporal: int
    inputs: int
    outputs: int
    token_frames: int = 1

    @property
    def folded(self) -> int:
        """Frames that a video token stands for."""
        return self.temporal * self.token_frames


@dataclass(frozen=True)
class PreparedMemory:
    """Memory of a batch, embedded once for all blocks and denoising steps.

    Args:
        tokens: what the form's blocks take.
        mask: what of it there is; nothing behind it changes the video.
    """

    tokens: Float[Tensor, "batch *group token width"]
    mask: Bool[Tensor, "batch *group token"]

    def only(self, kept: Bool[Tensor, " batch"]) -> Self:
        """The same batch in which all other samples see no memory."""
        kept = kept.reshape(-1, *[1] * (self.mask.ndim - 1))
        return dataclasses.replace(self, mask=self.mask & kept)

    def emptied(self) -> Self:
        """The same batch with every token behind the mask."""
        return dataclasses.replace(self, mask=torch.zeros_like(self.mask))


Prepared = TypeVar("Prepared", bound=PreparedMemory)


class Adapter(nn.Module, ABC, Generic[Prepared]):
    """A form of memory adapter.

    Args:
        channels: of the memory's features.
        settings: an instance of ``settings_type``.
        video: the model it stands in.

    Raises:
        CheckpointError: when no block would stand anywhere, or sizes do not go together.
    """

    settings_type: ClassVar[type[AdapterSettings]]
    settings: AdapterSettings
    blocks: nn.ModuleDict  # by the number of the transformer block at which each stands

    def __init__(self, channels: int, settings: AdapterSettings, video: VideoShape) -> None:
        super().__init__()
        if settings.every > video.layers:
            raise CheckpointError(f"adapter: every is {settings.every}, but the model has {video.layers} layers")
        self.channels = channels
        self.settings = settings
        self.video = video

    @abstractmethod
    def prepare(self, tokens: MemoryTokens, cameras: Cameras) -> Prepared:
        """Embed the tokens of a batch for the clip that the cameras look at."""

    def block_at(self, layer: int) -> nn.Module | None:
        """The adapter's block that stands at transformer block ``layer``, if one does."""
        name = str(layer)
        return self.blocks[name] if name in self.blocks else None  # noqa: SIM401 (no dictionary)

    def dropped(self, memory: Prepared, generators: list[torch.Generator]) -> Prepared:
        """Hide the memory of some training samples, for guidance over memory."""
        if self.settings.dropout == 0:
            return memory
        draws = torch.cat([torch.rand(1, generator=each) for each in generators])
        return memory.only((draws >= self.settings.dropout).to(memory.mask.device))

    def before(
        self, block: nn.Module, video: Float[Tensor, "batch token channel"], memory: Prepared
    ) -> Float[Tensor, "batch token channel"]:
        """The hidden states that the transformer block is given, where a block of the adapter stands at it."""
        return video

    def after(
        self,
        block: nn.Module,
        video: Float[Tensor, "batch token channel"],
        memory: Prepared,
        camera: Float[Tensor, "batch token camera"],
        time: Float[Tensor, "batch time"],
    ) -> Float[Tensor, "batch token channel"]:
        """The hidden states after the transformer block, where a block of the adapter stands at it."""
        return video

    def correct(
        self,
        predicted: Float[Tensor, "batch frame out height width"],
        inputs: Float[Tensor, "batch frame in height width"],
        memory: Prepared,
        time: Float[Tensor, "batch time"],
    ) -> Float[Tensor, "batch frame out height width"]:
        """What the adapter makes of the model's prediction; the same by default."""
        return predicted


class MemoryCondition:
    """What the transformer asks of memory around its blocks; this one is no memory at all and changes nothing."""

    def before(self, layer: int, video: Tensor) -> Tensor:
        """The hidden states that transformer block ``layer`` is given."""
        return video

    def after(self, layer: int, video: Tensor, camera: Tensor, time: Tensor) -> Tensor:
        """The hidden states that come after transformer block ``layer``."""
        return video

    def correct(self, predicted: Tensor, inputs: Tensor, time: Tensor) -> Tensor:
        """The prediction after the memory has corrected it."""
        return predicted


@dataclass(frozen=True)
class AdapterCondition(MemoryCondition, Generic[Prepared]):
    """An adapter with the memory that it prepared for a batch.

    Args:
        adapter: whose blocks stand at some of the transformer's blocks.
        memory: of the batch.
    """

    adapter: Adapter[Prepared]
    memory: Prepared

    def before(self, layer: int, video: Tensor) -> Tensor:
        """The hidden states that transformer block ``layer`` is given."""
        block = self.adapter.block_at(layer)
        return video if block is None else self.adapter.before(block, video, self.memory)

    def after(self, layer: int, video: Tensor, camera: Tensor, time: Tensor) -> Tensor:
        """The hidden states that come after transformer block ``layer``."""
        block = self.adapter.block_at(layer)
        return video if block is None else self.adapter.after(block, video, self.memory, camera, time)

    def correct(self, predicted: Tensor, inputs: Tensor, time: Tensor) -> Tensor:
        """The prediction after the memory has corrected it."""
        return self.adapter.correct(predicted, inputs, self.memory, time)

    def emptied(self) -> AdapterCondition[Prepared]:
        """The same adapter with an empty memory, for guidance."""
        return dataclasses.replace(self, memory=self.memory.emptied())
