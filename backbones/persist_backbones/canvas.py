"""``canvas``: tokens drawn into each target view and added to the hidden states."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from persist_backbones.adapter import Adapter, AdapterSettings, PreparedMemory, VideoShape, refuse_absolute
from persist_backbones.conditioning import fold_frames
from persist_backbones.splat import place, splat
from persist_cli.world.cameras import Cameras
from persist_cli.world.errors import CheckpointError
from persist_cli.world.tokens import MemoryTokens


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


class CanvasAdapter(Adapter):
    """Tokens splatted with a z-buffer into the view of each frame, embedded like patches and added.

    The views have the latents' size times ``canvas_scale``; frames are folded into channels as the camera latents
    are. Nothing after the drawing has a bias and every activation keeps zero, so a video token on whose pixels no
    memory token falls is that of stage 1 to the bit, before and after training alike.
    """

    def __init__(self, channels: int, settings: AdapterSettings, video: VideoShape) -> None:
        super().__init__(channels, settings, video)
        refuse_absolute(settings)
        if settings.splat_pixels % 2 == 0:
            raise CheckpointError(f"splat_pixels must be odd, not {settings.splat_pixels}")
        drawn = settings.canvas_channels
        self.embed = nn.Linear(channels, drawn)
        self.patch = video.patch * settings.canvas_scale
        self.patches = nn.Linear((drawn + 2) * video.temporal * self.patch**2, settings.width, bias=False)
        layers = range(0, video.layers, settings.every)
        self.blocks = nn.ModuleDict(
            {str(layer): CanvasBlock(video.channels, settings.width, settings.ff_factor) for layer in layers}
        )

    def prepare(self, tokens: MemoryTokens, cameras: Cameras) -> PreparedMemory:
        """Draw the tokens, fold frames, and embed the patch of each video token; the mask says where one fell."""
        patches = patchify(fold_frames(self.draw(tokens, cameras), self.video.temporal), self.patch)
        return PreparedMemory(F.gelu(self.patches(patches)), patches.detach().ne(0).any(dim=-1))

    def draw(self, tokens: MemoryTokens, cameras: Cameras) -> Float[Tensor, "batch frame channel height width"]:
        """What each frame's camera sees of the memory: embedded features, coverage and log depth."""
        height, width = (side // self.video.spatial for side in (cameras.height, cameras.width))
        views = cameras.resized(height * self.settings.canvas_scale, width * self.settings.canvas_scale)
        splats = place(tokens.positions, tokens.mask, views, self.settings.token_size, self.settings.splat_pixels)
        batch, frames = tokens.mask.shape[0], views.world_from_camera.shape[1]
        features = self.embed(tokens.features.to(self.patches.weight.dtype))
        return splat(features, splats, (batch, frames, views.height, views.width))

    def before_block(self, layer: int, video: Tensor, memory: PreparedMemory) -> Tensor:
        """The canvas added before this layer, where it is."""
        if str(layer) not in self.blocks:
            return video
        changed: Tensor = self.blocks[str(layer)](video, memory.tokens, memory.mask)
        return changed


def patchify(
    latents: Float[Tensor, "batch frame channel height width"], patch: int
) -> Float[Tensor, "batch token value"]:
    """All values of each video token's patch, in the order of the transformer's tokens."""
    parts = F.pixel_unshuffle(latents, patch)
    tokens: Tensor = parts.flatten(3).transpose(2, 3).flatten(1, 2)
    return tokens
