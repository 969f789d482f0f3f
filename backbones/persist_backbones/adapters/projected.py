"""The adapter ``projected``: the paper's memory block with each token's position in the views of each latent frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from persist_backbones.adapters.base import (
    NEAR,
    Adapter,
    OriginEmbedding,
    OriginSettings,
    PreparedMemory,
    VideoShape,
)
from persist_backbones.adapters.memory_block import AttentionSettings, memory_blocks, position_code
from persist_backbones.tensors import fold_frames
from persist_cli.api.cameras import Cameras
from persist_cli.api.geometry import pixel_centers, project
from persist_cli.api.tokens import MemoryTokens

WAVELENGTHS = (1 / 16, 2.0)  # in images; two images, so that both sides of an image and its margin have different codes
MARGIN = 0.25  # of the image: part of a token's cell is visible before its middle is
OCTAVES = 8.0  # 6 cm to 16 m, the depths of rooms, span one unit of log z as the image spans one of u and v


@dataclass(frozen=True)
class ProjectedSettings(AttentionSettings, OriginSettings):
    """Settings of the paper's memory block with positions in each latent frame's own cameras."""

    form: Literal["projected"] = "projected"


@dataclass(frozen=True)
class ProjectedMemory(PreparedMemory):
    """Memory tokens for each latent frame, and the positions of the video tokens.

    Args:
        places: position code of each video token of a latent frame.
    """

    places: Float[Tensor, "video_token code"]


class ProjectedAdapter(Adapter[ProjectedMemory]):
    """The form in which each latent frame attends to tokens with their projection (u, v, log z) into its own cameras.

    A latent frame that folds four frames takes the projections into all four, concatenated like the camera latents:
    in a fast turn only one of the four may see a token, and a mean or the last camera would lose it. The latent
    frames that a video token stands for are concatenated in the same way. A frame that does not see the token gives
    zeros and a zero flag. A latent frame attends only to tokens that one of its frames sees, so the softmax is shared
    by tokens that can be in the picture. Queries carry the code of the video token's own (u, v), at the same
    wavelengths.
    """

    settings_type = ProjectedSettings
    settings: ProjectedSettings

    def __init__(self, channels: int, settings: ProjectedSettings, video: VideoShape) -> None:
        super().__init__(channels, settings, video)
        code = video.folded * (6 * settings.frequencies + 1)
        self.embed = nn.Linear(channels, settings.width)
        self.origin = OriginEmbedding(settings.width, settings.origins)
        self.place = nn.Linear(code, settings.width, bias=False)
        self.blocks = memory_blocks(settings, video, video.camera_channels + 4 * settings.frequencies)

    def prepare(self, tokens: MemoryTokens, cameras: Cameras) -> ProjectedMemory:
        """Embed features and position codes and add them, for each latent frame."""
        frames, dtype = self.video.folded, self.embed.weight.dtype
        places, seen = image_places(tokens, cameras)
        code = torch.cat([self.code(places) * seen[..., None], seen[..., None].float()], dim=-1)
        folded = fold_frames(code.transpose(2, 3), frames).transpose(2, 3)
        mask = fold_frames(seen[:, :, None], frames).any(dim=2)
        features = self.origin(self.embed(tokens.features.to(dtype)), tokens.origins)
        hidden = features[:, None] + self.place(folded.to(dtype))
        places = self.query_places(cameras).to(dtype)
        return self.with_learned(ProjectedMemory(hidden * mask[..., None], mask, places))

    def after(
        self, block: nn.Module, video: Tensor, memory: ProjectedMemory, camera: Tensor, time: Tensor
    ) -> Float[Tensor, "batch token channel"]:
        """Return the video after the memory block, which treats each latent frame by itself."""
        frames = memory.mask.shape[1]
        places = memory.places.expand(len(video) * frames, -1, -1)
        split, views = (part.unflatten(1, (frames, -1)).flatten(0, 1) for part in (video, camera))
        query = torch.cat([views.to(places.dtype), places], dim=-1)
        instants = time.repeat_interleave(frames, dim=0)
        changed: Tensor = block(split, memory.tokens.flatten(0, 1), memory.mask.flatten(0, 1), query, instants)
        joined: Tensor = changed.unflatten(0, (-1, frames)).flatten(1, 2)
        return joined

    def code(self, places: Float[Tensor, "*batch axis"]) -> Float[Tensor, "*batch code"]:
        """Encode positions in the image by sines and cosines."""
        return position_code(places, self.settings.frequencies, *WAVELENGTHS)

    def query_places(self, cameras: Cameras) -> Float[Tensor, "video_token code"]:
        """Encode (u, v) of the middle of each video token of a latent frame."""
        edge = self.video.spatial * self.video.patch
        rows, columns = cameras.height // edge, cameras.width // edge
        middles = pixel_centers(rows, columns, cameras.world_from_camera.device)
        return self.code(middles.flatten(0, 1) / middles.new_tensor([columns, rows]))


def image_places(
    tokens: MemoryTokens, cameras: Cameras
) -> tuple[Float[Tensor, "batch frame token 3"], Bool[Tensor, "batch frame token"]]:
    """Return (u, v) in images and log₂ z / ``OCTAVES`` of each token in each frame, and whether the frame sees it."""
    frames = cameras.world_from_camera.shape[1]
    pixels, depth = project(tokens.positions[:, None].expand(-1, frames, -1, -1), cameras)
    image = pixels / pixels.new_tensor([cameras.width, cameras.height])
    inside = ((image > -MARGIN) & (image < 1 + MARGIN)).all(dim=-1)
    seen = inside & (depth > NEAR) & tokens.mask[:, None]
    logs = depth.clamp_min(NEAR).log2() / OCTAVES
    places = torch.cat([image, logs[..., None]], dim=-1)
    return torch.where(seen[..., None], places, torch.zeros_like(places)), seen
