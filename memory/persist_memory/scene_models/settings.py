"""The sizes of the model of scenes: of its codec, its transformer, and the windows that it knows."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from pydantic import Field

from persist_cli.api.cells import COMMON, CellForm
from persist_cli.api.scene_model import SceneForm
from persist_memory.metres import Metres

Count = Annotated[int, Field(ge=0)]
Positive = Annotated[int, Field(ge=1)]
Factor = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Amount = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, lt=1)]

REDUCTION = 4  # cells along the edge of a latent: two halvings


@dataclass(frozen=True)
class CodecSettings:
    """The sizes of the codec.

    Args:
        fold_levels: whether all levels above a place are channels of one latent, as suits houses; else latents divide
            the height too, as PERSIST's do.
        embedding: channels of a cell's class.
        channels: channels after the first halving and after the second.
        blocks: residual blocks at each size.
        latent: channels of a latent.
        components: principal components of the latents that the transformer generates; ``None`` for all.
        evenness: of their deviations: 1 makes all alike, 0 leaves them as they are: noise hides small ones first.
        cell: channels of a cell in the decoder, before its class and colour are read off.
        rare_weight: weight in the loss of a cell of a door or thing; all others have 1. Doors are so few that a codec
            that does not count them more makes walls of them. Where cells are read off it is divided out again.
        color_weight: weight of the colours' error.
        kl_weight: weight of the divergence of the latents from a normal distribution.
        noise: of latents before they are decoded in training, as a share of their deviation.
    """

    fold_levels: bool = True
    embedding: Positive = 8
    channels: tuple[Positive, Positive] = (64, 128)
    blocks: Positive = 1
    latent: Positive = 48
    components: Positive | None = None
    evenness: Annotated[float, Field(ge=0, le=1)] = 0.5
    cell: Positive = 16
    rare_weight: Factor = 8.0
    color_weight: Amount = 1.0
    kl_weight: Amount = 1e-6
    noise: Share = 0.1


@dataclass(frozen=True)
class TransformerSettings:
    """The sizes of the diffusion transformer.

    Args:
        layers: number of blocks.
        width: channels of a token.
        heads: heads of its attentions.
        patch: latents along the edge of a token.
        view_patch: pixels along the edge of a token of the view.
        region: tokens along the edge of a region.
        own_levels: share of the training samples in which each region has a noise level of its own.
        condition_noise: of given latents and of the view, in training and in sampling: (1 - n) x + n ε.
        drop_view: share of the samples without a view, for guidance.
        change_weight: weight in the loss of a token in which an interaction changes a cell; all others have 1. Mostly a
            single cell changes, which would hardly count.
    """

    layers: Positive = 6
    width: Positive = 160
    heads: Positive = 5
    patch: Positive = 1
    view_patch: Positive = 8
    region: Positive = 4
    own_levels: Share = 0.15
    condition_noise: Share = 0.1
    drop_view: Share = 0.1
    change_weight: Factor = 32.0

    def __post_init__(self) -> None:
        if self.width % (2 * self.heads):
            raise ValueError(f"width {self.width} must be a multiple of twice the heads, {2 * self.heads}")


@dataclass(frozen=True)
class OutcomeSettings:
    """The sizes of the network that says what interactions change.

    Args:
        embedding: channels of a cell's class.
        width: channels of a cell.
        blocks: residual blocks, each of which sees two cells farther.
        drop_action: share of the training samples that are not told the action, so that it is known what that is worth.
    """

    embedding: Positive = 8
    width: Positive = 32
    blocks: Positive = 2
    drop_action: Share = 0.1


@dataclass(frozen=True)
class SamplingSettings:
    """How windows are sampled.

    Args:
        shift: above 1 more steps, and more of the noise levels in training, are at high noise.
        guidance: how much more the view counts; 1 is off, and else each step takes twice as long.
        snap_every: steps after which the prediction is decoded, snapped to classes and encoded again, as PERSIST's is;
            0 for the end alone, since a small codec loses some of what is one cell thick each time, doors above all.
        snap_below: noise level from which on that is done.
    """

    shift: Factor = 3.0
    guidance: Amount = 1.0
    snap_every: Count = 0
    snap_below: Annotated[float, Field(ge=0, le=1)] = 0.5


@dataclass(frozen=True)
class SceneDiffusionSettings:
    """The windows that the model knows, and its sizes.

    Args:
        cell: edge of a cell in metres.
        palette: names of the classes, as those of the data; the first three are free, solid and outside.
        shape: cells along the two ground axes and up; multiples of 4 (the height only where levels are not folded).
        image: height and width of the view in pixels.
        actions: names of the interactions that it knows.
        untold_weight: of cells, in training, whose content the data do not say; they are taken for ``outside``.
        codec: the codec.
        transformer: the transformer.
        outcome: the network that says what interactions change.
        sampling: how windows are sampled.
    """

    cell: Metres = 0.25
    palette: Annotated[tuple[str, ...], Field(min_length=3, max_length=256)] = COMMON
    shape: tuple[Positive, Positive, Positive] = (64, 64, 12)
    image: tuple[Positive, Positive] = (64, 64)
    actions: tuple[str, ...] = ("pick_up", "drop", "toggle")
    untold_weight: Annotated[float, Field(ge=0, le=1)] = 0.1
    codec: CodecSettings = field(default_factory=CodecSettings)
    transformer: TransformerSettings = field(default_factory=TransformerSettings)
    outcome: OutcomeSettings = field(default_factory=OutcomeSettings)
    sampling: SamplingSettings = field(default_factory=SamplingSettings)

    def __post_init__(self) -> None:
        if self.palette[: len(COMMON)] != COMMON or len(set(self.palette)) < len(self.palette):
            raise ValueError(f"palette must begin with {', '.join(COMMON)} and name each class once")
        if self.components > self.codec.latent:
            raise ValueError(f"codec.components {self.components} must be at most codec.latent, {self.codec.latent}")
        unit, view = REDUCTION * self.transformer.patch, self.transformer.view_patch
        if any(length % unit for length in self.divided):
            raise ValueError(f"shape {list(self.shape)} must be multiples of {unit}, but the height of folded levels")
        if any(length % view for length in self.image):
            raise ValueError(f"image {list(self.image)} must be multiples of view_patch {view}")

    @property
    def is_named(self) -> bool:
        """Whether what is solid has classes."""
        return len(self.palette) > len(COMMON)

    @property
    def components(self) -> int:
        """The principal components of the latents that are generated."""
        return self.codec.components or self.codec.latent

    @property
    def divided(self) -> tuple[int, ...]:
        """The cells along the axes that latents divide."""
        return self.shape[:2] if self.codec.fold_levels else self.shape

    @property
    def latents(self) -> tuple[int, ...]:
        """The number of latents along each of these axes."""
        return tuple(length // REDUCTION for length in self.divided)

    @property
    def tokens(self) -> tuple[int, ...]:
        """The number of tokens along each of these axes."""
        return tuple(length // self.transformer.patch for length in self.latents)

    @property
    def form(self) -> SceneForm:
        """The windows that the model knows."""
        return SceneForm(CellForm(self.cell, self.palette), self.shape, self.image, self.actions)
