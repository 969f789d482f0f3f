"""``canvas``: tokens drawn into each target view and added to the hidden states."""

from __future__ import annotations

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from persist_backbones.adapter import Adapter, AdapterSettings, PreparedMemory, VideoShape, refuse_absolute
from persist_backbones.conditioning import fold_frames
from persist_backbones.splat import place, splat
from persist_cli.world.cameras import Cameras
from persist_cli.world.errors import CheckpointError
from persist_cli.world.tokens import MemoryTokens


class CanvasAdapter(Adapter):
    """Tokens splatted with a z-buffer into the view of each frame, embedded like patches and added.

    The views have the latents' size; frames are folded into channels as the camera latents are. Nothing after the
    drawing has a bias and every activation keeps zero, so a video token on whose pixels no memory token falls is
    that of stage 1 to the bit, before and after training alike.
    """

    def __init__(self, channels: int, settings: AdapterSettings, video: VideoShape) -> None:
        super().__init__(channels, settings, video)
        refuse_absolute(settings)
        if settings.splat_pixels % 2 == 0:
            raise CheckpointError(f"splat_pixels must be odd, not {settings.splat_pixels}")
        drawn = settings.canvas_channels
        self.embed = nn.Sequential(nn.Linear(channels, drawn), nn.LayerNorm(drawn))
        self.patches = nn.Linear((drawn + 2) * video.temporal * video.patch**2, settings.width, bias=False)
        self.outs = nn.ModuleDict(
            {
                str(layer): nn.Linear(settings.width, video.channels, bias=False)
                for layer in range(0, video.layers, settings.every)
            }
        )
        for parameter in self.outs.parameters():
            nn.init.zeros_(parameter)

    def prepare(self, tokens: MemoryTokens, cameras: Cameras) -> PreparedMemory:
        """Draw the tokens, fold frames, and embed the patch of each video token; the mask says where one fell."""
        patches = patchify(fold_frames(self.draw(tokens, cameras), self.video.temporal), self.video.patch)
        return PreparedMemory(F.gelu(self.patches(patches)), patches.detach().ne(0).any(dim=-1))

    def draw(self, tokens: MemoryTokens, cameras: Cameras) -> Float[Tensor, "batch frame channel height width"]:
        """What each frame's camera sees of the memory: embedded features, coverage and log depth."""
        spatial = self.video.spatial
        views = cameras.resized(cameras.height // spatial, cameras.width // spatial)
        splats = place(tokens.positions, tokens.mask, views, self.settings.token_size, self.settings.splat_pixels)
        batch, frames = tokens.mask.shape[0], views.world_from_camera.shape[1]
        features = self.embed(tokens.features.to(self.patches.weight.dtype))
        return splat(features, splats, (batch, frames, views.height, views.width))

    def before_block(self, layer: int, video: Tensor, memory: PreparedMemory) -> Tensor:
        """The canvas added before this layer, where it is."""
        if str(layer) not in self.outs:
            return video
        added: Tensor = self.outs[str(layer)](memory.tokens * memory.mask[..., None])
        return video + added.to(video.dtype)


def patchify(
    latents: Float[Tensor, "batch frame channel height width"], patch: int
) -> Float[Tensor, "batch token value"]:
    """All values of each video token's patch, in the order of the transformer's tokens."""
    parts = F.pixel_unshuffle(latents, patch)
    tokens: Tensor = parts.flatten(3).transpose(2, 3).flatten(1, 2)
    return tokens
