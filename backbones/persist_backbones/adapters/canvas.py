"""``canvas``: tokens drawn into each target view and added to the hidden states, and to the prediction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveInt
from torch import Tensor, nn

from persist_backbones.adapters.base import Adapter, AdapterSettings, PreparedMemory, VideoShape
from persist_backbones.adapters.splat import rasterize, splat
from persist_backbones.tensors import fold_frames, tokens_of, zero_init
from persist_cli.api.cameras import Cameras
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import CheckpointError


class CanvasHead(nn.Module):
    """Corrects the prediction by the canvas, beside the blocks and past them.

    A video token is narrower than the pixels it stands for: fine detail does not come through. Here each latent pixel
    sees the canvas on it and around it, the model's input and what the blocks made of both. Its last layer starts at
    zero, so a fresh head changes nothing.

    Args:
        drawn: channels of the canvas at a latent pixel.
        inputs: channels of the model's input.
        outputs: channels of its prediction.
        time: channels of the time embedding.
        width: channels inside.
    """

    def __init__(self, drawn: int, inputs: int, outputs: int, time: int, width: int) -> None:
        super().__init__()
        self.see = nn.Conv2d(drawn, width, 1)
        self.guess = nn.Conv2d(inputs + outputs, width, 1)
        self.modulation = nn.Linear(time, 2 * width)
        self.mix = nn.Conv2d(width, width, 3, padding=1)
        self.out = nn.Conv2d(width, outputs, 3, padding=1)
        zero_init(self.modulation, self.out)

    def forward(
        self,
        predicted: Float[Tensor, "batch frame out height width"],
        inputs: Float[Tensor, "batch frame in height width"],
        seen: Float[Tensor, "batch frame width height width"],
        time: Float[Tensor, "batch time"],
    ) -> Float[Tensor, "batch frame out height width"]:
        """What is to be added to the prediction; ``seen`` is that of ``look``."""
        frames = predicted.shape[1]
        both = torch.cat([inputs, predicted], dim=2).flatten(0, 1)
        scale, shift = self.modulation(F.silu(time)).repeat_interleave(frames, 0)[..., None, None].chunk(2, dim=1)
        hidden = (seen.flatten(0, 1) + self.guess(both)) * (1 + scale) + shift
        hidden = hidden + self.mix(F.gelu(hidden, approximate="tanh"))
        added: Tensor = self.out(F.gelu(hidden, approximate="tanh"))
        return torch.unflatten(added, 0, predicted.shape[:2])

    def look(self, canvas: Tensor) -> Float[Tensor, "batch frame width height width"]:
        """The canvas embedded, once for all denoising steps.

        Args:
            canvas: ``[batch, frame, drawn, height, width]`` at the latents' size.
        """
        seen: Tensor = self.see(canvas.flatten(0, 1))
        return torch.unflatten(seen, 0, canvas.shape[:2])


class CanvasBlock(nn.Module):
    """Adds to each video token what the canvas shows there, linearly and by a feed-forward of both.

    Args:
        channels: of the video's hidden states.
        width: of the canvas.
        ff_factor: hidden width of the feed-forward over the video's; 0 leaves it out.
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
        """The video with the canvas added where the mask is true, unchanged elsewhere."""
        added: Tensor = self.out(canvas)
        if self.up is not None and self.down is not None:
            both = torch.cat([self.norm(video), canvas.to(video.dtype)], dim=-1)
            added = added + self.down(F.gelu(self.up(both), approximate="tanh"))
        return video + (added * mask[..., None]).to(video.dtype)


@dataclass(frozen=True)
class CanvasSettings(AdapterSettings):
    """Tokens drawn into each view and added before every n-th transformer block, the first included.

    An ``ff_factor`` of 0 leaves the feed-forward out.

    Args:
        canvas_channels: features of a token as drawn.
        canvas_scale: pixels of the canvas along the edge of a latent pixel.
        token_size: edge in metres of what a token stands for; 0 draws points.
        splat_pixels: most canvas pixels along the edge of a drawn token, odd; 1 draws points.
        head_width: channels of what corrects the prediction at each latent pixel; 0 leaves it out.
    """

    form: Literal["canvas"] = "canvas"
    canvas_channels: PositiveInt = 32
    canvas_scale: PositiveInt = 1
    token_size: NonNegativeFloat = 0.25
    splat_pixels: PositiveInt = 5
    head_width: NonNegativeInt = 0


@dataclass(frozen=True)
class PreparedCanvas(PreparedMemory):
    """The canvas's patches, one for each video token.

    Args:
        seen: the canvas as the head sees it, at the latents' size; ``None`` without a head.
    """

    seen: Float[Tensor, "batch frame channel height width"] | None = None


class CanvasAdapter(Adapter[PreparedCanvas]):
    """Tokens splatted with a z-buffer into the view of each frame, embedded like patches and added.

    The views have the latents' size times ``canvas_scale``; frames are folded into channels as the camera latents
    are. Nothing between the drawing and the blocks has a bias and every activation keeps zero, and what the head adds
    is masked: to a video token on whose pixels no memory token falls nothing is added, before and after training
    alike; a clip on whose views none falls at all is that of stage 1 to the bit.
    """

    settings_type = CanvasSettings
    settings: CanvasSettings

    def __init__(self, channels: int, settings: CanvasSettings, video: VideoShape) -> None:
        super().__init__(channels, settings, video)
        if settings.splat_pixels % 2 == 0:
            raise CheckpointError(f"splat_pixels must be odd, not {settings.splat_pixels}")
        drawn = settings.canvas_channels
        self.embed = nn.Linear(channels, drawn)
        self.patch = video.patch * settings.canvas_scale
        self.patches = nn.Linear((drawn + 2) * video.folded * self.patch**2, settings.width, bias=False)
        layers = range(0, video.layers, settings.every)
        self.blocks = nn.ModuleDict(
            {str(layer): CanvasBlock(video.channels, settings.width, settings.ff_factor) for layer in layers}
        )
        pixel = (drawn + 2) * video.temporal * settings.canvas_scale**2
        sizes = (pixel, video.inputs, video.outputs, video.time_channels, settings.head_width)
        self.head = CanvasHead(*sizes) if settings.head_width else None

    def prepare(self, tokens: MemoryTokens, cameras: Cameras) -> PreparedCanvas:
        """Draw the tokens, fold frames, and embed the patch of each video token; the mask says where one fell."""
        views = fold_frames(self.draw(tokens, cameras), self.video.temporal, self.video.token_frames)
        folded = views.unflatten(1, (-1, self.video.token_frames)).flatten(2, 3)
        patches = tokens_of(F.pixel_unshuffle(folded, self.patch))
        seen = self.head.look(F.pixel_unshuffle(views, self.settings.canvas_scale)) if self.head else None
        return PreparedCanvas(F.gelu(self.patches(patches)), patches.detach().ne(0).any(dim=-1), seen)

    def draw(self, tokens: MemoryTokens, cameras: Cameras) -> Float[Tensor, "batch frame channel height width"]:
        """What each frame's camera sees of the memory: embedded features, coverage and log depth."""
        height, width = (side // self.video.spatial for side in (cameras.height, cameras.width))
        views = cameras.resized(height * self.settings.canvas_scale, width * self.settings.canvas_scale)
        splats = rasterize(tokens.positions, tokens.mask, views, self.settings.token_size, self.settings.splat_pixels)
        batch, frames = tokens.mask.shape[0], views.world_from_camera.shape[1]
        features = self.embed(tokens.features.to(self.patches.weight.dtype))
        return splat(features, splats, (batch, frames, views.height, views.width))

    def before(self, block: nn.Module, video: Tensor, memory: PreparedCanvas) -> Tensor:
        """The video with the canvas added."""
        changed: Tensor = block(video, memory.tokens, memory.mask)
        return changed

    def correct(self, predicted: Tensor, inputs: Tensor, memory: PreparedCanvas, time: Tensor) -> Tensor:
        """The prediction with what the head adds, on the pixels of video tokens on which a memory token fell."""
        if self.head is None or memory.seen is None:
            return predicted
        batch, frames, _, height, width = predicted.shape
        side, token_frames = self.video.patch, self.video.token_frames
        mask = memory.mask.reshape(batch, frames // token_frames, 1, height // side, width // side)
        mask = mask.repeat_interleave(token_frames, 1).repeat_interleave(side, -2).repeat_interleave(side, -1)
        added: Tensor = self.head(predicted, inputs, memory.seen, time) * mask
        return predicted + added.to(predicted.dtype)
