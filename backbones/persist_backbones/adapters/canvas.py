"""The adapter ``canvas``: it draws tokens into each target view and adds them to hidden states and prediction."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, cast

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveInt
from torch import Tensor, nn

from persist_backbones.adapters.base import (
    Adapter,
    NoiseLevel,
    OriginEmbedding,
    OriginSettings,
    PreparedMemory,
    VideoShape,
)
from persist_backbones.adapters.splat import rasterize, splat
from persist_backbones.tensors import fold_frames, tokens_of, zero_init
from persist_cli.api.cameras import Cameras
from persist_cli.api.geometry import camera_rays
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import CheckpointError


class CanvasHead(nn.Module):
    """A network that corrects the prediction by the canvas at each latent pixel, after all transformer blocks.

    A video token has fewer channels than the pixels that it stands for, so fine detail is lost in it. The head instead
    takes for each latent pixel the canvas there and around it, the model's input and its prediction. Its last layer
    starts at zero, so a fresh head changes nothing.

    Args:
        canvas: channels of the canvas at a latent pixel.
        inputs: channels of the model's input.
        outputs: channels of the prediction.
        time: channels of the time embedding.
        width: hidden channels.
    """

    def __init__(self, canvas: int, inputs: int, outputs: int, time: int, width: int) -> None:
        super().__init__()
        self.see = nn.Conv2d(canvas, width, 1)
        self.guess = nn.Conv2d(inputs + outputs, width, 1)
        self.modulation = nn.Linear(time, 2 * width)
        self.mix = nn.Conv2d(width, width, 3, padding=1)
        self.out = nn.Conv2d(width, outputs, 3, padding=1)
        zero_init(self.modulation, self.out)

    def forward(
        self,
        predicted: Float[Tensor, "batch frame out height width"],
        inputs: Float[Tensor, "batch frame in height width"],
        canvas: Float[Tensor, "batch frame width height width"],
        time: Float[Tensor, "batch time"],
    ) -> Float[Tensor, "batch frame out height width"]:
        """Return the correction, which is added to the prediction; ``canvas`` is what ``look`` returned."""
        correction: Tensor = self.out(F.gelu(self.hidden(predicted, inputs, canvas, time), approximate="tanh"))
        return torch.unflatten(correction, 0, predicted.shape[:2])

    def hidden(
        self, predicted: Tensor, inputs: Tensor, canvas: Tensor, time: Tensor
    ) -> Float[Tensor, "image channel height width"]:
        """Return what the last layer takes, frames on the batch axis; the arguments are those of ``forward``."""
        frames = predicted.shape[1]
        both = torch.cat([inputs, predicted], dim=2).flatten(0, 1)
        scale, shift = self.modulation(F.silu(time)).repeat_interleave(frames, 0)[..., None, None].chunk(2, dim=1)
        hidden = (canvas.flatten(0, 1) + self.guess(both)) * (1 + scale) + shift
        mixed: Tensor = hidden + self.mix(F.gelu(hidden, approximate="tanh"))
        return mixed

    def look(self, canvas: Tensor) -> Float[Tensor, "batch frame width height width"]:
        """Embed the canvas, once for all denoising steps.

        Args:
            canvas: ``[batch, frame, channel, height, width]`` at the latents' size.
        """
        embedded: Tensor = self.see(canvas.flatten(0, 1))
        return torch.unflatten(embedded, 0, canvas.shape[:2])


class CanvasBlock(nn.Module):
    """A block that adds to each video token its patch of the canvas, and a feed-forward of token and patch.

    Args:
        channels: channels of the video's hidden states.
        width: channels of the canvas at a video token.
        ff_factor: hidden width of the feed-forward as a multiple of ``channels``; 0 leaves it out.
    """

    def __init__(self, channels: int, width: int, ff_factor: float) -> None:
        super().__init__()
        hidden = int(channels * ff_factor)
        self.out = nn.Linear(width, channels, bias=False)
        self.norm = nn.LayerNorm(channels, elementwise_affine=False)
        self.up = nn.Linear(channels + width, hidden, bias=False) if hidden else None
        self.down = nn.Linear(hidden, channels, bias=False) if hidden else None
        for layer in (self.out, self.down):
            if layer is not None:
                nn.init.zeros_(layer.weight)

    def forward(
        self,
        video: Float[Tensor, "batch token channel"],
        canvas: Float[Tensor, "batch token width"],
        mask: Bool[Tensor, "batch token"],
    ) -> Float[Tensor, "batch token channel"]:
        """Return the video with the canvas added where the mask is true, unchanged elsewhere."""
        change: Tensor = self.out(canvas)
        if self.up is not None and self.down is not None:
            both = torch.cat([self.norm(video), canvas.to(video.dtype)], dim=-1)
            change = change + self.down(F.gelu(self.up(both), approximate="tanh"))
        return video + (change * mask[..., None]).to(video.dtype)


@dataclass(frozen=True)
class CanvasSettings(OriginSettings):
    """Settings of the adapter that adds its canvas before every n-th transformer block, the first included.

    An ``ff_factor`` of 0 leaves the feed-forward out.

    Args:
        canvas_channels: channels of a token's features on the canvas.
        canvas_scale: pixels of the canvas along the edge of a latent pixel.
        token_size: edge in metres of the square that a token is drawn as; 0 draws points.
        splat_pixels: the largest edge of a drawn token in canvas pixels, odd; 1 draws points.
        head_width: hidden channels of the layers that correct the prediction by the canvas; 0 leaves them out.
    """

    form: Literal["canvas"] = "canvas"
    canvas_channels: PositiveInt = 32
    canvas_scale: PositiveInt = 1
    token_size: NonNegativeFloat = 0.25
    splat_pixels: PositiveInt = 5
    head_width: NonNegativeInt = 0


@dataclass(frozen=True)
class PreparedCanvas(PreparedMemory):
    """The canvas as patches, one for each video token.

    Args:
        seen: the canvas embedded for the head, at the latents' size; ``None`` without a head.
        blank: the canvas of learned tokens alone; ``None`` where there are none, since then it is hidden by the mask.
    """

    seen: Float[Tensor, "batch frame channel height width"] | None = None
    blank: PreparedCanvas | None = None

    def only(self, samples: Bool[Tensor, " batch"]) -> PreparedCanvas:
        """Return this canvas, and for all samples that are false in ``samples`` the one without a memory."""
        if self.blank is None:
            return super().only(samples)
        tokens, mask = _choose(samples, self.tokens, self.blank.tokens), _choose(samples, self.mask, self.blank.mask)
        if self.seen is None or self.blank.seen is None:
            return replace(self, tokens=tokens, mask=mask)
        return replace(self, tokens=tokens, mask=mask, seen=_choose(samples, self.seen, self.blank.seen))


class CanvasAdapter(Adapter[PreparedCanvas]):
    """The form that splats tokens with a z-buffer into the view of each frame and adds the view's embedded patches.

    The views have the latents' size times ``canvas_scale``; frames are folded into channels like the camera latents.
    No layer between the drawing and the blocks has a bias, every activation keeps zero, and the head's correction is
    masked. So a video token whose pixels no memory token covers stays unchanged, before and after training, and a clip
    whose views show no memory token equals that of stage 1 to the bit.
    """

    settings_type = CanvasSettings
    settings: CanvasSettings

    def __init__(self, channels: int, settings: CanvasSettings, video: VideoShape) -> None:
        super().__init__(channels, settings, video)
        if settings.splat_pixels % 2 == 0:
            raise CheckpointError(f"splat_pixels must be odd, not {settings.splat_pixels}")
        canvas_channels = settings.canvas_channels
        self.embed = nn.Linear(channels, canvas_channels)
        self.origin = OriginEmbedding(canvas_channels, settings.origins)
        self.patch = video.patch * settings.canvas_scale
        self.patches = nn.Linear((canvas_channels + 2) * video.folded * self.patch**2, settings.width, bias=False)
        layers = range(0, video.layers, settings.every)
        self.blocks = nn.ModuleDict(
            {str(layer): CanvasBlock(video.channels, settings.width, settings.ff_factor) for layer in layers}
        )
        pixel = (canvas_channels + 2) * video.temporal * settings.canvas_scale**2
        sizes = (pixel, video.inputs, video.outputs, video.time_channels, settings.head_width)
        self.head = CanvasHead(*sizes) if settings.head_width else None

    @staticmethod
    def learned_channels(settings: CanvasSettings) -> int:
        """Return the channels of a learned token, which are those of a drawn one."""
        return settings.canvas_channels

    def prepare(self, tokens: MemoryTokens, cameras: Cameras) -> PreparedCanvas:
        """Draw the tokens, and the learned ones where no token is."""
        canvas = self.draw(tokens, cameras)
        if self.learned is None:
            return self.embed_canvas(canvas)
        sky = self.draw_learned(cameras).to(canvas.dtype)
        blank = torch.cat([sky, torch.zeros_like(canvas[:, :, -2:])], dim=2)
        covered = canvas[:, :, -2:-1] > 0
        return replace(self.embed_canvas(torch.where(covered, canvas, blank)), blank=self.embed_canvas(blank))

    def embed_canvas(self, canvas: Float[Tensor, "batch frame channel height width"]) -> PreparedCanvas:
        """Fold the frames of a drawn canvas, embed the patch of each video token, and mask empty patches."""
        views = fold_frames(canvas, self.video.temporal, self.video.token_frames)
        folded = views.unflatten(1, (-1, self.video.token_frames)).flatten(2, 3)
        patches = tokens_of(F.pixel_unshuffle(folded, self.patch))
        embedded = self.head.look(F.pixel_unshuffle(views, self.settings.canvas_scale)) if self.head else None
        return PreparedCanvas(F.gelu(self.patches(patches)), patches.detach().ne(0).any(dim=-1), embedded)

    def draw(self, tokens: MemoryTokens, cameras: Cameras) -> Float[Tensor, "batch frame channel height width"]:
        """Draw the memory into the view of each frame's camera, as embedded features, coverage and log depth."""
        height, width = (side // self.video.spatial for side in (cameras.height, cameras.width))
        views = cameras.resized(height * self.settings.canvas_scale, width * self.settings.canvas_scale)
        splats = rasterize(tokens.positions, tokens.mask, views, self.settings.token_size, self.settings.splat_pixels)
        batch, frames = tokens.mask.shape[0], views.world_from_camera.shape[1]
        features = self.origin(self.embed(tokens.features.to(self.patches.weight.dtype)), tokens.origins)
        return splat(features, splats, (batch, frames, views.height, views.width))

    def draw_learned(self, cameras: Cameras) -> Float[Tensor, "batch frame channel height width"]:
        """Draw the learned tokens behind all others: they lie on a sphere around the first camera, far away.

        A latent pixel shows the token whose direction is nearest to its ray.
        """
        learned, scale = cast(Tensor, self.learned), self.settings.canvas_scale
        views = cameras.resized(cameras.height // self.video.spatial, cameras.width // self.video.spatial)
        rotations = views.world_from_camera[..., :3, :3].double()
        rays = camera_rays(views) @ (rotations[:, :1].mT @ rotations)[:, :, None].mT
        nearest = (rays.float() @ sphere(len(learned)).to(rays.device).T).argmax(dim=-1)
        drawn = learned[nearest].permute(0, 1, 4, 2, 3)
        return drawn.repeat_interleave(scale, dim=-2).repeat_interleave(scale, dim=-1)

    def before(self, block: nn.Module, video: Tensor, memory: PreparedCanvas) -> Tensor:
        """Return the video with the canvas added."""
        changed: Tensor = block(video, memory.tokens, memory.mask)
        return changed

    def correct(
        self, predicted: Tensor, inputs: Tensor, memory: PreparedCanvas, time: Tensor, level: NoiseLevel
    ) -> Tensor:
        """Add the head's correction to the prediction, on the pixels of video tokens that a memory token covers."""
        if self.head is None or memory.seen is None:
            return predicted
        batch, frames, _, height, width = predicted.shape
        side, token_frames = self.video.patch, self.video.token_frames
        mask = memory.mask.reshape(batch, frames // token_frames, 1, height // side, width // side)
        mask = mask.repeat_interleave(token_frames, 1).repeat_interleave(side, -2).repeat_interleave(side, -1)
        correction: Tensor = self.head(predicted, inputs, memory.seen, time) * mask
        return predicted + correction.to(predicted.dtype)


def sphere(count: int) -> Float[Tensor, "point 3"]:
    """Return unit vectors that are spread evenly over all directions (the Fibonacci lattice)."""
    numbers = torch.arange(count) + 0.5
    angles, heights = math.pi * (1 + math.sqrt(5)) * numbers, 1 - 2 * numbers / count
    radii = (1 - heights.square()).sqrt()
    return torch.stack([radii * angles.cos(), heights, radii * angles.sin()], dim=-1)


def _choose(samples: Bool[Tensor, " batch"], chosen: Tensor, other: Tensor) -> Tensor:
    """Return for each sample the tensor's row where ``samples`` is true, else the other's."""
    return torch.where(samples.reshape(-1, *[1] * (chosen.ndim - 1)), chosen, other)
