"""The adapter ``rendered``: point-cloud renders of the memory, encoded by the frozen codec, are inputs of the model.

Known from ViewCrafter (2409.02048), See3D (2412.06699), TrajectoryCrafter (2503.05638) and GEN3C (2503.03751): what the
memory shows in each target view is drawn as an RGB-D image, holes are filled, and the clip of these images goes through
the video model's own frozen VAE. Its latents and the mask of what was drawn are further input channels of the
transformer. Here they also correct the prediction at each latent pixel, and ``projected`` attention brings in what is
not drawn. Where a memory tells classes, as a scene does, the first surfaces along each ray are given too (``peeling``).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple, Self

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int64, Shaped, UInt8
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt
from torch import Tensor, nn

from persist_backbones.adapters.base import (
    NEAR,
    Adapter,
    Encode,
    NoiseLevel,
    OriginSettings,
    PreparedMemory,
    VideoShape,
)
from persist_backbones.adapters.canvas import CanvasHead
from persist_backbones.adapters.memory_block import AttentionSettings
from persist_backbones.adapters.peeling import VALUES, LayerEmbedding, peel
from persist_backbones.adapters.projected import ProjectedAdapter, ProjectedMemory, ProjectedSettings, image_places
from persist_backbones.adapters.splat import (
    Splats,
    coarser,
    draw_means,
    hide_covered,
    rasterize,
)
from persist_backbones.distinct_views import distinct_views
from persist_backbones.noise_levels import add_level
from persist_backbones.tensors import clip_by_clip, fold_frames, fold_patches, latent_shares, push_pull, zero_init
from persist_cli.api.cameras import Cameras
from persist_cli.api.observations import Origin
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import CheckpointError

SPARSE = 0.125  # share of a latent pixel at which a fresh gate is half open: holes between points are filled well


@dataclass(frozen=True)
class RenderedSettings(AttentionSettings, OriginSettings):
    """Settings of the adapter that renders its tokens; those of attention are for the tokens that are not rendered.

    So is ``origins``, since the views always tell what was imagined.

    Args:
        token_size: edge in metres of the square that a token is drawn as, somewhat more than the edge of a cell.
        splat_pixels: largest edge of a drawn token in pixels, plus 1 / ``supersampling`` where ``splat_pixels`` ×
            ``supersampling`` is even: with 9 and 2 it is 9.5. 1 draws points only where ``supersampling`` is 1.
        hole_share: a pixel that shows something clearly farther than this share of the pixels around it is a hole,
            through which what is behind a wall would show, and is left out like one without a token; 0 leaves it.
        thickness: metres behind the nearest token at a pixel in which tokens are of the same surface: their mean is
            drawn, in which those count more that were seen from nearer.
        supersampling: number n of an antialiased drawing, in which a pixel is the mean of n × n that are drawn.
        head_width: hidden channels of the layers that correct the prediction by the rendered views.
        head_layers: number of those layers that look at neighbouring latent pixels.
        attention_tokens: tokens that ``projected`` attention reads of those that no view shows; 0 leaves attention out
            where there are no learned tokens either.
        color_error: variance of the rendered latents of colour about the true ones, where those of the codec have about
            1; the larger it is, the less a fresh adapter trusts drawn colours. Cells of one colour each have about 1.
        depth_error: the same of the latents of depth.
        layers: surfaces along each ray, one behind the other, that the model is also given with class, colour, depth
            and origin; 0 for the rendered views alone.
        layer_gap: metres from a surface to where the next one begins.
        layer_scale: pixels of the layers along the edge of a latent pixel.
        layer_width: channels to which the layers of a pixel are reduced.
        classes: number of classes, one-hot in the features of the tokens, that layers tell; 0 for none.
        class_channels: channels of the embedding of a class.
    """

    form: Literal["rendered"] = "rendered"
    token_budget: PositiveInt = 65536
    token_size: PositiveFloat = 0.03
    splat_pixels: PositiveInt = 9
    hole_share: Annotated[float, Field(ge=0, le=1)] = 0.5
    thickness: NonNegativeFloat = 0.05
    supersampling: PositiveInt = 2
    head_width: PositiveInt = 96
    head_layers: PositiveInt = 2
    attention_tokens: NonNegativeInt = 256
    color_error: PositiveFloat = 0.05
    depth_error: PositiveFloat = 0.05
    layers: NonNegativeInt = 0
    layer_gap: PositiveFloat = 0.3
    layer_scale: PositiveInt = 2
    layer_width: PositiveInt = 16
    classes: NonNegativeInt = 0
    class_channels: PositiveInt = 32


class Views(NamedTuple):
    """What a memory shows in the views of clips; holes are filled from around them.

    Args:
        rgb: uint8 RGB.
        depth: planar z in metres.
        covered: the share of a pixel that shows what was observed, and the share that shows what was imagined; both
            are 0 in holes.
        shown: for each token whether a view shows it.
        splats: the pixels of the drawing that each token covers, hidden or not.
    """

    rgb: UInt8[Tensor, "batch frame height width 3"]
    depth: Float[Tensor, "batch frame height width"]
    covered: Float[Tensor, "batch frame origin height width"]
    shown: Bool[Tensor, "batch token"]
    splats: Splats


def render_views(tokens: MemoryTokens, cameras: Cameras, settings: RenderedSettings) -> Views:
    """Draw tokens with a z-buffer into the views of cameras, at the images' full size.

    Args:
        tokens: the tokens of a batch, with colours.
        cameras: axes ``batch frame``.
        settings: the size of a token's square, which faces the camera, and the supersampling.

    Raises:
        CheckpointError: when the tokens have no colours.
    """
    if tokens.colors is None:
        raise CheckpointError(
            "the adapter form 'rendered' draws tokens in their colours, but this memory's tokens have none; use the "
            "memory voxel, map2d or snapshots, or another form"
        )
    finer = settings.supersampling
    views = cameras.resized(cameras.height * finer, cameras.width * finer)
    shape = (*cameras.world_from_camera.shape[:2], views.height, views.width)
    drawn_pixels = rasterize(tokens.positions, tokens.mask, views, settings.token_size, settings.splat_pixels * finer)
    splats, _ = hide_covered(drawn_pixels, shape, settings.thickness, settings.hole_share)
    shown = torch.zeros_like(tokens.mask).flatten().index_fill(0, splats.token, True).view_as(tokens.mask)
    pictures, observed, covered = _surfaces(tokens, splats, shape, finer).split([4, 1, 1], dim=1)
    filled = push_pull(pictures, covered).unflatten(0, shape[:2])
    origins = torch.cat([observed, covered - observed], dim=1).unflatten(0, shape[:2])
    return Views(filled[:, :, 1:].movedim(2, -1).round().to(torch.uint8), filled[:, :, 0], origins, shown, drawn_pixels)


def _surfaces(
    tokens: MemoryTokens, splats: Splats, shape: tuple[int, ...], finer: int
) -> Float[Tensor, "view 6 height width"]:
    """Return depth, colour, whether it was observed, and 1 of the surface at each pixel; zeros where there is none.

    Of its splats those that were seen from nearer count more: a pixel from half the distance shows a quarter of the
    area, and counts as the four that would cover what the other shows.
    """
    assert tokens.colors is not None
    columns = [tokens.colors.float(), (tokens.origins == Origin.OBSERVED)[..., None].float()]
    distances = torch.ones_like(tokens.mask, dtype=torch.float32) if tokens.distances is None else tokens.distances
    weights = distances.clamp_min(NEAR).square().reciprocal()
    return draw_means(torch.cat(columns, dim=-1).flatten(0, 1), weights.flatten(), splats, shape, finer)


def tokens_not_shown(tokens: MemoryTokens, shown: Bool[Tensor, "batch token"], cameras: Cameras, most: int) -> Tensor:
    """Return numbers of tokens that no view shows although they lie in or beside one: hidden, or just out of sight.

    They are spread evenly over the order of the tokens, which begins with the most relevant.

    Args:
        tokens: the tokens of a batch.
        shown: the tokens that a view shows.
        cameras: the cameras of the views.
        most: largest number of tokens of a sample.

    Returns:
        For each sample ``most`` numbers, -1 where there are fewer such tokens.
    """
    if not most:
        return torch.zeros(len(shown), 0, dtype=torch.int64, device=shown.device)
    rows = []
    for sample in range(len(shown)):  # one at a time: the places of all would take much memory
        one = MemoryTokens(*(part[sample : sample + 1] for part in (tokens.features, tokens.positions, tokens.mask)))
        poses, matrices = cameras.world_from_camera[sample : sample + 1], cameras.intrinsics[sample : sample + 1]
        _, beside = image_places(one, dataclasses.replace(cameras, world_from_camera=poses, intrinsics=matrices))
        count = (beside.any(dim=1)[0] & ~shown[sample]).cumsum(0)
        wanted = torch.arange(most, device=count.device)
        spread = wanted * count[-1].clamp_min(most) // most
        rows.append(torch.where(spread < count[-1], torch.searchsorted(count, spread + 1), -1))
    return torch.stack(rows)


class RenderedHead(CanvasHead):
    """A network that moves the prediction towards the rendered views at each latent pixel and channel.

    Let r be the latents of the rendered views and x the clean latents as predicted. The new ones are x + g (r − x), and
    a correction is added to the prediction. A fresh head corrects nothing, and its gate g is open where points cover a
    latent pixel, if only sparsely: g = 1 / (1 + SNR · error) is the weight of r in the mean of two measurements of
    x, one by the noisy latents, with errors of variance 1 / SNR, and one by the rendered views, whose errors have the
    variance of the settings ``color_error`` and ``depth_error``.

    Args:
        drawn: channels of latents, mask and layers of the rendered views.
        video: sizes of the video model.
        settings: sizes of the head, and the errors of rendered latents.
    """

    def __init__(self, drawn: int, video: VideoShape, settings: RenderedSettings) -> None:
        width = settings.head_width
        super().__init__(drawn, video.inputs, video.outputs, video.time_channels, width)
        self.more = nn.ModuleList(nn.Conv2d(width, width, 3, padding=1) for _ in range(settings.head_layers - 1))
        self.gate = nn.Conv2d(width, video.outputs, 3, padding=1)
        zero_init(self.gate)
        self.errors = settings.color_error, settings.depth_error

    def hidden(self, predicted: Tensor, inputs: Tensor, canvas: Tensor, time: Tensor) -> Tensor:
        """Return what the last layers take, frames on the batch axis."""
        hidden: Tensor = super().hidden(predicted, inputs, canvas, time)
        for layer in self.more:
            hidden = hidden + layer(F.gelu(hidden, approximate="tanh"))
        return hidden

    def moved(
        self, predicted: Tensor, inputs: Tensor, memory: PreparedRendering, time: Tensor, level: NoiseLevel
    ) -> Float[Tensor, "batch frame out height width"]:
        """Return the prediction, moved towards the rendered views and corrected; see ``Adapter.correct``."""
        hidden = F.gelu(self.hidden(predicted, inputs, memory.seen, time), approximate="tanh")
        correction, gate = (layer(hidden).unflatten(0, predicted.shape[:2]) for layer in (self.out, self.gate))
        color, _, depth, _ = inputs[:, :, : 2 * predicted.shape[2]].chunk(4, dim=2)
        clean = level.clean(predicted, torch.cat([color, depth], dim=2))
        snr = (level.signal / level.noise).square()
        errors = torch.cat([snr.new_full((predicted.shape[2] // 2, 1, 1), error) for error in self.errors])
        doubt = (SPARSE / memory.share.clamp_min(1e-3)).square() + snr * errors
        opened = torch.sigmoid(gate - doubt.log()) * (memory.share > 0)
        moved: Tensor = level.moved(predicted, opened * (memory.latents - clean)) + correction
        return moved


@dataclass(frozen=True)
class PreparedRendering(PreparedMemory):
    """The rendered views of a batch: their patch embedding at each video token, masked where no view shows anything.

    Args:
        latents: latents of the rendered views.
        share: share of the pixels of a latent pixel that are covered.
        seen: latents, mask and layers, embedded for the head.
        blank: what the head sees where nothing is rendered.
        attention: the tokens that no view shows, ``None`` without attention.
    """

    latents: Float[Tensor, "batch frame out height width"]
    share: Float[Tensor, "batch frame 1 height width"]
    seen: Float[Tensor, "batch frame hidden height width"]
    blank: Float[Tensor, " hidden"]
    attention: ProjectedMemory | None = None

    def only(self, samples: Bool[Tensor, " batch"]) -> Self:
        """Return this memory, hidden from all samples but those that are true in ``samples``."""
        shown = samples[:, None, None, None, None]
        return dataclasses.replace(
            super().only(samples),
            latents=self.latents * shown,
            share=self.share * shown,
            seen=torch.where(shown, self.seen, self.blank[:, None, None]),
            attention=None if self.attention is None else self.attention.only(samples),
        )


class RenderedAdapter(Adapter[PreparedRendering]):
    """The form that renders tokens into the views and encodes them by the frozen codec, once for all denoising steps.

    Latents, mask and layers are embedded like the model's own input, without a bias and starting at zero, and added to
    the video tokens before the first transformer block; after the last one a head corrects the prediction by them. The
    mask has for each latent pixel and frame the shares of its pixels that show what was observed, and what was
    imagined. Video tokens of which no pixel is covered stay as they are, as do latent frames without a token to attend
    to: a clip whose views show nothing equals that of stage 1 to the bit, before and after training, unless the adapter
    has learned tokens.
    """

    settings_type = RenderedSettings
    draws_tokens = True
    settings: RenderedSettings

    def __init__(self, channels: int, settings: RenderedSettings, video: VideoShape) -> None:
        super().__init__(channels, settings, video)
        drawn = video.outputs + 2 * video.temporal
        self.layers: LayerEmbedding | None = None
        if settings.layers:
            _check_layers(settings, channels, video.spatial)
            sizes = settings.layers, settings.classes, settings.class_channels, settings.layer_width
            self.layers = LayerEmbedding(*sizes)
            drawn += settings.layer_width * video.temporal * settings.layer_scale**2
        self.patches = nn.Linear(drawn * video.token_frames * video.patch**2, video.channels, bias=False)
        zero_init(self.patches)
        self.head = RenderedHead(drawn, video, settings)
        self.register_parameter("learned", None)  # learned tokens are those of attention
        shared = {field.name: getattr(settings, field.name) for field in dataclasses.fields(ProjectedSettings)}
        attention = ProjectedSettings(**shared | {"form": "projected", "noise": 0.0})
        reads = settings.attention_tokens or settings.learned_tokens
        self.attention = ProjectedAdapter(channels, attention, video) if reads else None

    @property
    def blocks(self) -> nn.ModuleDict:  # type: ignore[override]
        """The memory blocks of ``projected`` attention."""
        return nn.ModuleDict() if self.attention is None else self.attention.blocks

    def render(self, tokens: MemoryTokens, cameras: Cameras, encode: Encode) -> MemoryTokens:
        """Return latents, mask and layers of the rendered views, float16, with the tokens for attention.

        Where the clips share their tokens, each distinct view is rendered once, and attention reads tokens that no view
        of any clip shows.
        """
        if tokens.rendered is not None:
            return tokens
        if tokens.shared and self.video.temporal == 1:
            distinct, numbers = distinct_views(cameras)
            drawn, shown = self.rendered(tokens.first(len(distinct)), distinct, encode)
            drawn, shown = drawn.flatten(0, 1)[numbers], shown.any(dim=0).expand(len(numbers), -1)
        else:
            drawn, shown = self.rendered(tokens, cameras, encode)
        attended = tokens_not_shown(tokens, shown, cameras, self.settings.attention_tokens)
        rest = {name: _chosen(part, attended.clamp_min(0)) for name, part in tokens.tensors().items()}
        return MemoryTokens(**rest | {"mask": attended >= 0, "rendered": drawn.half()})

    def rendered(
        self, tokens: MemoryTokens, cameras: Cameras, encode: Encode
    ) -> tuple[Float[Tensor, "batch frame channel height width"], Bool[Tensor, "batch token"]]:
        """Return latents, mask and layers of the views, and which tokens any view of their clip shows."""
        points, finer = tokens.mask.shape[1], self.settings.supersampling
        rgb, depth, mask, shown, *layers = clip_by_clip(self.drawn, tokens, cameras=cameras, points=points, finer=finer)
        latents = encode(rgb, depth) * mask.any(dim=2, keepdim=True)
        return torch.cat([latents, mask.to(latents), *layers], dim=2), shown

    def drawn(self, tokens: MemoryTokens, cameras: Cameras) -> tuple[Tensor, ...]:
        """Return colours and depth of the views, the mask at each latent pixel, which tokens a view shows, layers."""
        views = render_views(tokens, cameras, self.settings)
        mask = latent_shares(views.covered, self.video.spatial, self.video.temporal)
        return views.rgb, views.depth, mask, views.shown, *self.peeled(tokens, views)

    def peeled(self, tokens: MemoryTokens, views: Views) -> list[Float[Tensor, "batch frame folded height width"]]:
        """Return the layers of the views folded to the size of latents, none where the adapter has none."""
        settings, video = self.settings, self.video
        if not settings.layers:
            return []
        batch, frames, height, width = views.depth.shape
        size = (height * settings.layer_scale // video.spatial, width * settings.layer_scale // video.spatial)
        splats = coarser(views.splats, (height * settings.supersampling, width * settings.supersampling), size)
        surfaces = peel(tokens, splats, (batch, frames, *size), settings.layers, settings.layer_gap, settings.classes)
        folded = F.pixel_unshuffle(surfaces.flatten(2, 3), settings.layer_scale)
        return [fold_frames(folded, video.temporal)]

    def embedded(self, surfaces: Float[Tensor, "batch frame folded height width"]) -> list[Tensor]:
        """Return the embedding of folded layers, channels in the place of layers and values, none without layers."""
        if self.layers is None:
            return []
        settings = self.settings
        split = (self.video.temporal, settings.layers, VALUES, settings.layer_scale**2)
        pixels = surfaces.unflatten(2, split).permute(0, 1, 2, 5, 6, 7, 3, 4)
        drawn = self.layers(pixels.flatten(0, 5)).unflatten(0, pixels.shape[:6])
        return [drawn.permute(0, 1, 2, 3, 6, 4, 5).flatten(2, 4)]

    def rendering(self) -> Mapping[str, Any]:
        """Return the settings that ``render`` depends on."""
        settings = self.settings
        names = ["token_size", "splat_pixels", "hole_share", "thickness", "supersampling", "attention_tokens"]
        names += ["layers", "layer_gap", "layer_scale", "classes"] if settings.layers else []
        return {name: getattr(settings, name) for name in names}

    def noisy(
        self, tokens: MemoryTokens, level: Float[Tensor, " batch"], generators: list[torch.Generator]
    ) -> MemoryTokens:
        """Return rendered tokens with noise of a level on their latents, where they cover anything, and features."""
        assert tokens.rendered is not None
        latents, mask, surfaces = self.split(tokens.rendered)
        noisy = add_level(latents, level, generators) * mask.any(dim=2, keepdim=True)
        tokens = super().noisy(tokens, level, generators)
        drawn = torch.cat([part.float() for part in (noisy, mask, surfaces)], dim=2)  # autocast joins no float16
        return dataclasses.replace(tokens, rendered=drawn.to(latents.dtype))

    def split(self, rendered: Float[Tensor, "batch frame channel height width"]) -> tuple[Tensor, Tensor, Tensor]:
        """Return latents, mask and folded layers of what ``render`` returned."""
        shown = self.video.outputs + 2 * self.video.temporal
        latents, mask = rendered[:, :, :shown].split([self.video.outputs, 2 * self.video.temporal], dim=2)
        return latents, mask, rendered[:, :, shown:]

    def prepare(self, tokens: MemoryTokens, cameras: Cameras) -> PreparedRendering:
        """Embed what ``render`` returned."""
        assert tokens.rendered is not None
        video, weights = self.video, self.patches.weight
        latents, mask, surfaces = self.split(fold_frames(tokens.rendered.float(), 1, video.token_frames))
        latents, mask = latents.to(weights.dtype), mask.to(weights.dtype)
        drawn = torch.cat([latents, mask, *self.embedded(surfaces)], dim=2)
        covered = fold_patches(mask, video.patch, video.token_frames).any(dim=-1)
        return PreparedRendering(
            tokens=self.patches(fold_patches(drawn, video.patch, video.token_frames)),
            mask=covered,
            latents=latents,
            share=mask.sum(dim=2, keepdim=True) / video.temporal,
            seen=self.head.look(drawn),
            blank=self.head.look(torch.zeros_like(drawn[:1, :1, :, :1, :1])).flatten(),
            attention=None if self.attention is None else self.attention.prepare(tokens, cameras),
        )

    def begin(self, video: Tensor, memory: PreparedRendering) -> Tensor:
        """Return the video tokens with the patches of the rendered views added."""
        return video + (memory.tokens * memory.mask[..., None]).to(video.dtype)

    def after(
        self, block: nn.Module, video: Tensor, memory: PreparedRendering, camera: Tensor, time: Tensor
    ) -> Float[Tensor, "batch token channel"]:
        """Return the video after the memory block, unchanged in latent frames without a token to attend to."""
        assert self.attention is not None
        assert memory.attention is not None
        changed = self.attention.after(block, video, memory.attention, camera, time)
        attends = memory.attention.mask.any(dim=-1)
        return torch.where(attends.repeat_interleave(video.shape[1] // attends.shape[1], 1)[..., None], changed, video)

    def correct(
        self, predicted: Tensor, inputs: Tensor, memory: PreparedRendering, time: Tensor, level: NoiseLevel
    ) -> Tensor:
        """Return the prediction, moved towards the rendered views where they cover something of a video token.

        An adapter with learned tokens corrects it everywhere.
        """
        moved = self.head.moved(predicted, inputs, memory, time, level).to(predicted.dtype)
        if self.settings.learned_tokens:
            return moved
        batch, frames, _, height, width = predicted.shape
        side, token_frames = self.video.patch, self.video.token_frames
        mask = memory.mask.reshape(batch, frames // token_frames, 1, height // side, width // side)
        mask = mask.repeat_interleave(token_frames, 1).repeat_interleave(side, -2).repeat_interleave(side, -1)
        return torch.where(mask, moved, predicted)


def _check_layers(settings: RenderedSettings, channels: int, spatial: int) -> None:
    """Raise ``CheckpointError`` unless tokens have so many classes and latent pixels can be divided so."""
    if settings.classes > channels:
        raise CheckpointError(f"adapter: classes is {settings.classes}, but a token has {channels} channels")
    if spatial % settings.layer_scale:
        raise CheckpointError(f"adapter: layer_scale is {settings.layer_scale}; it must divide {spatial} pixels")


def _chosen(part: Shaped[Tensor, "batch token *rest"], numbers: Int64[Tensor, "batch chosen"]) -> Tensor:
    """Return some rows of each sample."""
    index = numbers.reshape(*numbers.shape, *[1] * (part.ndim - 2)).expand(-1, -1, *part.shape[2:])
    return part.gather(1, index)
