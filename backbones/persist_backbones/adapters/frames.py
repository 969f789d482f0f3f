"""The adapter ``frames``: the video attends to patches of remembered frames, encoded by the codec, by their rays.

It is for memories of whole frames, which know no depth. What the video has to find out is which patch shows the surface
that a ray hits: nobody tells it, as in Context as Memory (2506.03141) and WorldMem (2504.12369).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from pydantic import PositiveInt
from torch import Tensor, nn

from persist_backbones.adapters.base import Adapter, Encode, PreparedMemory, VideoShape
from persist_backbones.adapters.memory_block import RAY, AttentionSettings, memory_blocks, position_code
from persist_backbones.noise_levels import add_level
from persist_cli.api.cameras import Cameras, invert_rigid
from persist_cli.api.geometry import plucker
from persist_cli.api.observations import Origin
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import CheckpointError

WAVELENGTHS = (0.25, 16.0)  # of the code of rays: metres of their moments, lengths of their directions


@dataclass(frozen=True)
class FramesSettings(AttentionSettings):
    """Settings of the adapter that attends to whole frames.

    Args:
        token_budget: the largest number of frames that is read from memory for a clip.
        frame_patch: latent pixels along the edge of a patch of a remembered frame.
    """

    form: Literal["frames"] = "frames"
    token_budget: PositiveInt = 4
    frame_patch: PositiveInt = 2


class FramesAdapter(Adapter[PreparedMemory]):
    """The form in which the video attends to patches of remembered frames.

    Frames are encoded one by one, as images, by the video model's own codec, so that they are in the space in which the
    video is denoised. A patch carries its latents, its Plücker ray relative to the first camera of the clip, as the
    video's tokens do in the query, and whether the frame was observed or imagined.
    """

    settings_type = FramesSettings
    settings: FramesSettings
    reads_frames = True

    def __init__(self, channels: int, settings: FramesSettings, video: VideoShape) -> None:
        super().__init__(channels, settings, video)
        latents = video.outputs // 2  # of colour alone
        self.embed = nn.Linear(latents * settings.frame_patch**2, settings.width)
        self.place = nn.Linear(RAY * (1 + 2 * settings.frequencies), settings.width, bias=False)
        self.origin = nn.Embedding(max(Origin) + 1, settings.width)
        self.blocks = memory_blocks(settings, video, video.camera_channels)

    def check_latents(self, height: int, width: int) -> None:
        """Raise ``CheckpointError`` when frames cannot be cut into whole patches."""
        patch = self.settings.frame_patch
        if height % patch or width % patch:
            raise CheckpointError(f"adapter.frame_patch is {patch}; it must divide {height}×{width} latent pixels")

    def render(self, tokens: MemoryTokens, cameras: Cameras, encode: Encode) -> MemoryTokens:
        """Encode the images of the tokens, which are not needed afterwards.

        Raises:
            CheckpointError: when the tokens are no frames.
        """
        if tokens.images is None:
            if tokens.latents is None and bool(tokens.mask.any()):
                raise CheckpointError(
                    "the adapter form 'frames' reads whole frames, but this memory's tokens are points; use the memory "
                    "context or views, or another form"
                )
            return tokens
        images = tokens.images.flatten(0, 1)[:, None]
        encoded = encode(images, torch.zeros(images.shape[:-1], device=images.device))[:, 0, : self.video.outputs // 2]
        latents = encoded.unflatten(0, tokens.mask.shape) * tokens.mask[:, :, None, None, None]
        return dataclasses.replace(tokens, images=None, latents=latents)

    def rendering(self) -> Mapping[str, Any]:
        """Return that images are encoded."""
        return {"form": self.settings.form}

    def noisy(
        self, tokens: MemoryTokens, level: Float[Tensor, " batch"], generators: list[torch.Generator]
    ) -> MemoryTokens:
        """Return the frames of a batch with noise of a level on their latents."""
        if tokens.latents is None:
            return tokens
        return dataclasses.replace(tokens, latents=add_level(tokens.latents, level, generators, mask=tokens.mask))

    def prepare(self, tokens: MemoryTokens, cameras: Cameras) -> PreparedMemory:
        """Embed latents, rays and origins of the patches of all frames, and add them."""
        if tokens.latents is None or tokens.world_from_camera is None or tokens.intrinsics is None:
            return self.with_learned(self.nothing(tokens))
        side, dtype = self.settings.frame_patch, self.embed.weight.dtype
        patches = F.pixel_unshuffle(tokens.latents.to(dtype), side)
        rows, columns = patches.shape[-2:]
        hidden = self.embed(patches.movedim(2, -1)) + self.place(self.rays(tokens, cameras, rows, columns).to(dtype))
        hidden = hidden + self.origin(tokens.origins.long())[:, :, None, None]
        mask = tokens.mask[:, :, None, None].expand(hidden.shape[:-1])
        return self.with_learned(PreparedMemory((hidden * mask[..., None]).flatten(1, 3), mask.flatten(1, 3)))

    def nothing(self, tokens: MemoryTokens) -> PreparedMemory:
        """Return one patch that is left out, of which all weights get gradients: DDP waits for each."""
        weights, count = self.embed.weight, len(tokens.mask)
        hidden = self.embed(weights.new_zeros(count, 1, self.embed.in_features))
        hidden = hidden + self.place(weights.new_zeros(count, 1, self.place.in_features)) + self.origin.weight[:1]
        return PreparedMemory(hidden * 0, tokens.mask.new_zeros(count, 1))

    def after(
        self, block: nn.Module, video: Tensor, memory: PreparedMemory, camera: Tensor, time: Tensor
    ) -> Float[Tensor, "batch token channel"]:
        """Return the video after the memory block."""
        changed: Tensor = block(video, memory.tokens, memory.mask, camera, time)
        return changed

    def rays(
        self, tokens: MemoryTokens, cameras: Cameras, rows: int, columns: int
    ) -> Float[Tensor, "batch token rows columns code"]:
        """Return the Plücker rays of the patches relative to the first camera of each clip, and their code."""
        assert tokens.world_from_camera is not None
        assert tokens.intrinsics is not None
        first = invert_rigid(cameras.world_from_camera[:, :1].double())
        identity = torch.eye(3, dtype=torch.float64, device=tokens.mask.device)
        matrices = torch.where(tokens.mask[..., None, None], tokens.intrinsics.double(), identity)  # none in padding
        size = self.video.spatial * self.settings.frame_patch
        frames = Cameras(first @ tokens.world_from_camera.double(), matrices, rows * size, columns * size)
        rays = plucker(frames.resized(rows, columns))
        return torch.cat([rays.float(), position_code(rays, self.settings.frequencies, *WAVELENGTHS)], dim=-1)

    def count(self, tokens: MemoryTokens, cameras: Cameras) -> int:
        """Return the number of patches of one sample's frames."""
        size = self.video.spatial * self.settings.frame_patch
        return super().count(tokens, cameras) * (cameras.height // size) * (cameras.width // size)
