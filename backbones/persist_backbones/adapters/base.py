"""The base class of memory adapters, which change the video by the tokens of a memory (their forms: see ``forms``).

An adapter prepares the tokens of a batch once, changes the hidden states before or after some transformer blocks, and
may correct the prediction.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Generic, Self, TypeVar

import torch
from jaxtyping import Bool, Float, UInt8
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveInt
from torch import Tensor, nn

from persist_backbones.noise_levels import LevelEmbedding, add_level
from persist_cli.api.cameras import Cameras
from persist_cli.api.observations import Origin
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import CheckpointError

NEAR = 0.05  # metres in front of a camera; a token that is nearer is not visible


@dataclass(frozen=True)
class AdapterSettings:
    """Settings that every form of adapter has.

    Args:
        form: the way of the tokens to the video: ``cross`` (attention to tokens at their places in space, as in the
            paper), ``projected`` (attention to their places in the views), ``canvas`` (tokens drawn into the views),
            ``rendered`` (views rendered from the tokens, encoded by the codec) or ``frames`` (attention to whole
            frames, encoded by the codec).
        every: the adapter has a block at every n-th transformer block; this is n.
        width: channels of a memory token inside the blocks, or of the canvas at a video token.
        ff_factor: hidden width of the feed-forward as a multiple of the video's channels.
        token_budget: the largest number of tokens that is read from memory for a clip.
        dropout: share of the training samples that see no memory, for guidance over memory.
        learned_tokens: number of tokens that are learned with the adapter and are there in every clip, with and without
            a memory. They give an adapter of memory ``none`` something to learn.
        noise: largest level of the noise that training adds to the features of the tokens, and to the latents of
            rendered ones, where 1 is as strong as these themselves; the model is told the level. 0 for neither.
    """

    form: str
    every: PositiveInt = 1
    width: PositiveInt = 128
    ff_factor: NonNegativeFloat = 2.0
    token_budget: PositiveInt = 256
    dropout: Annotated[float, Field(ge=0, le=1)] = 0.1
    learned_tokens: NonNegativeInt = 0
    noise: NonNegativeFloat = 0.0


@dataclass(frozen=True)
class OriginSettings(AdapterSettings):
    """Settings of the forms whose tokens tell their origin only when asked to.

    Args:
        origins: whether tokens that were imagined are marked by an embedding, which starts at zero and learns where
            training shows such tokens, as with ``data.own_writes``.
    """

    origins: bool = False


@dataclass(frozen=True)
class VideoShape:
    """The sizes of the video model that an adapter is built for.

    Args:
        channels: channels of the hidden states.
        camera_channels: channels of the camera embedding at each video token.
        time_channels: channels of the time embedding.
        layers: number of transformer blocks.
        patch: latent pixels along the edge of a video token.
        spatial: compression of the codec in height and width.
        temporal: compression of the codec in time.
        inputs: channels of the model's whole input at a latent pixel.
        outputs: channels of the prediction at a latent pixel.
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
        """Number of frames of the clip that a video token stands for."""
        return self.temporal * self.token_frames


class OriginEmbedding(nn.Module):
    """An embedding that marks tokens that were imagined; a fresh one is zero and changes nothing.

    Observed tokens stay as they are, before and after training.

    Args:
        width: channels of an embedded token.
        marks: whether any token is marked; else there is nothing to learn, and nothing in the weights.
    """

    imagined: nn.Parameter | None

    def __init__(self, width: int, marks: bool) -> None:
        super().__init__()
        self.register_parameter("imagined", nn.Parameter(torch.zeros(width)) if marks else None)

    def forward(
        self, embedded: Float[Tensor, "batch *group token width"], origins: UInt8[Tensor, "batch *group token"]
    ) -> Float[Tensor, "batch *group token width"]:
        """Return embedded tokens with the embedding added to those whose origin is imagined."""
        if self.imagined is None:
            return embedded
        imagined = (origins == Origin.IMAGINED)[..., None]
        return embedded + self.imagined.to(embedded.dtype) * imagined


Encode = Callable[[Tensor, Tensor], Tensor]  # uint8 RGB and metres of clips to latents of both, as ``Codec.encode``


@dataclass(frozen=True)
class NoiseLevel:
    """The noise level of each sample of a prediction, x_t = signal · x₀ + noise · ε.

    Args:
        signal: √ᾱ_t of each sample.
        noise: √(1 − ᾱ_t) of each sample.
        velocity: whether the model predicts the velocity signal · ε − noise · x₀; else it predicts x₀.
    """

    signal: Float[Tensor, "batch 1 1 1 1"]
    noise: Float[Tensor, "batch 1 1 1 1"]
    velocity: bool

    def clean(self, predicted: Tensor, noisy: Tensor) -> Tensor:
        """Return x₀ as the model predicts it from ``noisy``, x_t."""
        return self.signal * noisy - self.noise * predicted if self.velocity else predicted

    def moved(self, predicted: Tensor, change: Tensor) -> Tensor:
        """Return the prediction whose x₀ differs by ``change``."""
        return predicted - change / self.noise if self.velocity else predicted + change


@dataclass(frozen=True)
class PreparedMemory:
    """The memory of a batch, embedded once for all blocks and denoising steps.

    Args:
        tokens: embedded tokens, as the blocks of the form take them.
        mask: true for tokens that exist; all other tokens change nothing in the video.
        learned: number of tokens at the end that are the adapter's own; they are never hidden.
        level: noise level of each sample's tokens, ``None`` for 0.
    """

    tokens: Float[Tensor, "batch *group token width"]
    mask: Bool[Tensor, "batch *group token"]
    learned: int = field(default=0, kw_only=True)
    level: Float[Tensor, " batch"] | None = field(default=None, kw_only=True)

    def only(self, samples: Bool[Tensor, " batch"]) -> Self:
        """Return this memory, hidden from all samples but those that are true in ``samples``."""
        samples = samples.reshape(-1, *[1] * (self.mask.ndim - 1))
        own = torch.arange(self.mask.shape[-1], device=self.mask.device) >= self.mask.shape[-1] - self.learned
        return dataclasses.replace(self, mask=self.mask & (samples | own))

    def emptied(self) -> Self:
        """Return this memory with all tokens masked out but the adapter's own."""
        return self.only(self.mask.new_zeros(len(self.mask)))


Prepared = TypeVar("Prepared", bound=PreparedMemory)


class Adapter(nn.Module, ABC, Generic[Prepared]):
    """A memory adapter; each subclass is one form.

    Args:
        channels: channels of the features of a memory token.
        settings: an instance of ``settings_type``.
        video: sizes of the video model.

    Raises:
        CheckpointError: when the adapter would have no block, or its sizes do not fit each other.
    """

    settings_type: ClassVar[type[AdapterSettings]]
    reads_frames: ClassVar[bool] = False  # whether tokens must be whole frames
    draws_tokens: ClassVar[bool] = False  # whether a token that no view shows changes nothing that is drawn
    settings: AdapterSettings
    blocks: nn.ModuleDict  # the key is the number of the transformer block
    learned: nn.Parameter | None  # the learned tokens

    def __init__(self, channels: int, settings: AdapterSettings, video: VideoShape) -> None:
        super().__init__()
        if settings.every > video.layers:
            raise CheckpointError(f"adapter: every is {settings.every}, but the model has {video.layers} layers")
        self.channels = channels
        self.settings = settings
        self.video = video
        count, size = settings.learned_tokens, self.learned_channels(settings)
        self.register_parameter("learned", nn.Parameter(torch.randn(count, size)) if count else None)
        self.level = LevelEmbedding(video.time_channels) if settings.noise else None

    @staticmethod
    def learned_channels(settings: Any) -> int:
        """Return the channels of a learned token, which are those of an embedded one."""
        width: int = settings.width
        return width

    def render(self, tokens: MemoryTokens, cameras: Cameras, encode: Encode) -> MemoryTokens:
        """Return what ``prepare`` needs of the tokens of clips; by default all of them, nothing is rendered.

        Args:
            tokens: the tokens of a batch.
            cameras: axes ``batch frame``.
            encode: the frozen codec.
        """
        return tokens

    def rendering(self) -> Mapping[str, Any] | None:
        """Return the settings that ``render`` depends on, as JSON values; ``None`` when it keeps all tokens."""
        return None

    def count(self, tokens: MemoryTokens, cameras: Cameras) -> int:
        """Return how many tokens the adapter makes of one sample's tokens for a path of cameras."""
        return int(tokens.mask.sum())

    @abstractmethod
    def prepare(self, tokens: MemoryTokens, cameras: Cameras) -> Prepared:
        """Embed the tokens of a batch for the clips that the cameras see."""

    def with_learned(self, memory: Prepared) -> Prepared:
        """Append the learned tokens to the embedded ones; for forms that attend to tokens."""
        if self.learned is None:
            return memory
        group = memory.mask.shape[:-1]
        own = self.learned.to(memory.tokens.dtype).expand(*group, -1, -1)
        return dataclasses.replace(
            memory,
            tokens=torch.cat([memory.tokens, own], dim=-2),
            mask=torch.cat([memory.mask, memory.mask.new_ones(*group, len(self.learned))], dim=-1),
            learned=len(self.learned),
        )

    def check_latents(self, height: int, width: int) -> None:
        """Raise ``CheckpointError`` when settings do not go with images of so many latent pixels; most go with any."""

    def noisy(
        self, tokens: MemoryTokens, level: Float[Tensor, " batch"], generators: list[torch.Generator]
    ) -> MemoryTokens:
        """Return the tokens of a batch with noise of a level on their features; see ``AdapterSettings.noise``."""
        mask = tokens.mask[..., None].to(tokens.features.dtype)
        count = (mask.sum((1, 2)) * tokens.features.shape[-1]).clamp_min(1)
        unit = ((tokens.features * mask).square().sum((1, 2)) / count).sqrt()
        features = add_level(tokens.features, level, generators, unit, tokens.mask)
        return dataclasses.replace(tokens, features=features)

    def time(self, time: Float[Tensor, "batch time"], memory: Prepared) -> Float[Tensor, "batch time"]:
        """Return the time embedding with that of the memory's noise level, unchanged for samples without a token."""
        if self.level is None:
            return time
        level = time.new_zeros(len(time)) if memory.level is None else memory.level
        has_tokens = memory.mask.flatten(1).any(dim=1)
        embedded: Tensor = self.level(level) * has_tokens[:, None]
        return time + embedded.to(time.dtype)

    def block_at(self, layer: int) -> nn.Module | None:
        """Return the adapter's block at transformer block ``layer``, ``None`` where it has none."""
        name = str(layer)
        return self.blocks[name] if name in self.blocks else None  # noqa: SIM401 (no dictionary)

    def dropped(self, memory: Prepared, generators: list[torch.Generator]) -> Prepared:
        """Hide the memory from training samples drawn with the generators, for guidance over memory."""
        if self.settings.dropout == 0:
            return memory
        draws = torch.cat([torch.rand(1, generator=generator) for generator in generators])
        return memory.only((draws >= self.settings.dropout).to(memory.mask.device))

    def begin(
        self, video: Float[Tensor, "batch token channel"], memory: Prepared
    ) -> Float[Tensor, "batch token channel"]:
        """Return the embedded video tokens, before the first transformer block; by default unchanged."""
        return video

    def before(
        self, block: nn.Module, video: Float[Tensor, "batch token channel"], memory: Prepared
    ) -> Float[Tensor, "batch token channel"]:
        """Return the input of a transformer block at which the adapter has ``block``; by default unchanged."""
        return video

    def after(
        self,
        block: nn.Module,
        video: Float[Tensor, "batch token channel"],
        memory: Prepared,
        camera: Float[Tensor, "batch token camera"],
        time: Float[Tensor, "batch time"],
    ) -> Float[Tensor, "batch token channel"]:
        """Change the output of a transformer block at which the adapter has ``block``; by default it stays."""
        return video

    def correct(
        self,
        predicted: Float[Tensor, "batch frame out height width"],
        inputs: Float[Tensor, "batch frame in height width"],
        memory: Prepared,
        time: Float[Tensor, "batch time"],
        level: NoiseLevel,
    ) -> Float[Tensor, "batch frame out height width"]:
        """Correct the model's prediction by the memory; by default it stays."""
        return predicted


class MemoryCondition:
    """The memory as the transformer uses it around its blocks; this base class is no memory and changes nothing."""

    def time(self, time: Tensor) -> Tensor:
        """Return the time embedding, which may say how noisy the memory is."""
        return time

    def begin(self, video: Tensor) -> Tensor:
        """Return the embedded video tokens, before the first transformer block."""
        return video

    def before(self, layer: int, video: Tensor) -> Tensor:
        """Return the input of transformer block ``layer``."""
        return video

    def after(self, layer: int, video: Tensor, camera: Tensor, time: Tensor) -> Tensor:
        """Return the hidden states after transformer block ``layer``."""
        return video

    def correct(self, predicted: Tensor, inputs: Tensor, time: Tensor, level: NoiseLevel) -> Tensor:
        """Return the prediction, corrected by the memory."""
        return predicted


@dataclass(frozen=True)
class AdapterCondition(MemoryCondition, Generic[Prepared]):
    """An adapter with the memory that it prepared for a batch.

    Args:
        adapter: the adapter.
        memory: what ``adapter.prepare`` returned for the batch.
    """

    adapter: Adapter[Prepared]
    memory: Prepared

    def time(self, time: Tensor) -> Tensor:
        """Return the time embedding, which may say how noisy the memory is."""
        return self.adapter.time(time, self.memory)

    def begin(self, video: Tensor) -> Tensor:
        """Return the embedded video tokens, before the first transformer block."""
        return self.adapter.begin(video, self.memory)

    def before(self, layer: int, video: Tensor) -> Tensor:
        """Return the input of transformer block ``layer``."""
        block = self.adapter.block_at(layer)
        return video if block is None else self.adapter.before(block, video, self.memory)

    def after(self, layer: int, video: Tensor, camera: Tensor, time: Tensor) -> Tensor:
        """Return the hidden states after transformer block ``layer``."""
        block = self.adapter.block_at(layer)
        return video if block is None else self.adapter.after(block, video, self.memory, camera, time)

    def correct(self, predicted: Tensor, inputs: Tensor, time: Tensor, level: NoiseLevel) -> Tensor:
        """Return the prediction, corrected by the memory."""
        return self.adapter.correct(predicted, inputs, self.memory, time, level)

    def emptied(self) -> AdapterCondition[Prepared]:
        """Return the adapter with an empty memory, for guidance."""
        return dataclasses.replace(self, memory=self.memory.emptied())
