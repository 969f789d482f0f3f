"""The adapter ``cross``, the paper's own: every frame attends to one set of tokens with positions in metres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from pydantic import NonNegativeInt
from torch import Tensor, nn

from persist_backbones.adapters.base import Adapter, OriginEmbedding, OriginSettings, PreparedMemory, VideoShape
from persist_backbones.adapters.memory_block import RAY, AttentionSettings, memory_blocks, position_code
from persist_backbones.tensors import fold_frames
from persist_cli.api.cameras import Cameras, invert_rigid
from persist_cli.api.geometry import transform
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import CheckpointError

NARROWEST, WIDEST = 0.25, 8.0  # wavelengths of the code of directions, where 1 is the radius of their sphere


@dataclass(frozen=True)
class CrossSettings(AttentionSettings, OriginSettings):
    """Settings of the paper's cross-attention to tokens with positions in metres.

    The paper concatenates the position code to a token's features, so that keys and values have it, and the camera to
    the video's queries. The last four settings are options of our own, for ablations.

    Args:
        positions: ``relative`` to the first camera of the clip, ``absolute`` in the world, as in the paper, or
            ``none``: tokens without a position.
        normalize: layer norm of the features before they are embedded. DINOv2's features are some five times as large
            as the position code and have six times its channels, so that the position is a hundredth of a token.
        key_positions: whether the position code is given to the keys of every block too.
        key_camera: whether the keys of each latent frame also have the ray from its cameras to the token, in the form
            in which the queries have the camera: then a token lies on a video token's ray where the two are alike.
        ray_frequencies: wavelengths of a code of these rays' directions that queries and keys have too; 0 for none.
            From bare directions attention becomes sharp only by large weights, which take many steps to grow.
    """

    form: Literal["cross"] = "cross"
    positions: Literal["relative", "absolute", "none"] = "relative"
    normalize: bool = False
    key_positions: bool = False
    key_camera: bool = False
    ray_frequencies: NonNegativeInt = 0


@dataclass(frozen=True)
class CrossMemory(PreparedMemory):
    """Memory tokens, one set for all frames, and what their keys have besides.

    Args:
        codes: concatenated to the keys of each latent frame, or of all of them; ``None`` for nothing.
    """

    codes: Float[Tensor, "batch frame token code"] | None = None


class CrossAdapter(Adapter[CrossMemory]):
    """The paper's form: the video cross-attends, after transformer blocks, to features with a position code."""

    settings_type = CrossSettings
    settings: CrossSettings

    def __init__(self, channels: int, settings: CrossSettings, video: VideoShape) -> None:
        super().__init__(channels, settings, video)
        if settings.key_positions and settings.positions == "none":
            raise CheckpointError("adapter: key_positions needs positions, not none; give positions=relative")
        if settings.ray_frequencies and not settings.key_camera:
            raise CheckpointError("adapter: ray_frequencies codes rays of queries and keys; give key_camera=true")
        code = 0 if settings.positions == "none" else 6 * settings.frequencies
        self.embed = nn.Linear(channels + code, settings.width)
        self.origin = OriginEmbedding(settings.width, settings.origins)
        coded = 1 + settings.ray_frequencies  # sine and cosine of three axes: as many as a ray has channels
        self.blocks = memory_blocks(settings, video, video.camera_channels * coded)
        keys = code * settings.key_positions + RAY * video.folded * settings.key_camera * coded
        for block in self.blocks.values() if keys else ():
            block.add_key_code(keys)  # type: ignore[operator]  # a ModuleDict does not know the type of its values

    def prepare(self, tokens: MemoryTokens, cameras: Cameras) -> CrossMemory:
        """Concatenate the position code to the features and project them."""
        dtype = self.embed.weight.dtype
        features, code = tokens.features, self.position_code(tokens, cameras)
        if self.settings.normalize:
            features = F.layer_norm(features, features.shape[-1:])
        hidden = self.origin(self.embed(torch.cat([features, code], dim=-1).to(dtype)), tokens.origins)
        codes = [code[:, None]] if self.settings.key_positions else []
        if self.settings.key_camera:
            rays = fold_frames(token_rays(tokens, cameras).transpose(2, 3), self.video.folded).transpose(2, 3)
            rays = self.with_direction_code(rays)
            codes = [part.expand(-1, rays.shape[1], -1, -1) for part in codes] + [rays.float()]
        learned = self.settings.learned_tokens  # they are nowhere, so that their code is zero
        joined = F.pad(torch.cat(codes, dim=-1), (0, 0, 0, learned)).to(dtype) if codes else None
        return self.with_learned(CrossMemory(hidden * tokens.mask[..., None], tokens.mask, joined))

    def position_code(self, tokens: MemoryTokens, cameras: Cameras) -> Float[Tensor, "batch token code"]:
        """Encode the tokens' positions in the settings' frame of reference; no channels without positions."""
        positions = tokens.positions
        if self.settings.positions == "none":
            return tokens.features[..., :0]
        if self.settings.positions == "relative":
            positions = transform(invert_rigid(cameras.world_from_camera[:, 0].double()), positions)
        return position_code(positions, self.settings.frequencies)

    def after(
        self, block: nn.Module, video: Tensor, memory: CrossMemory, camera: Tensor, time: Tensor
    ) -> Float[Tensor, "batch token channel"]:
        """Return the video after the memory block."""
        rays = self.with_direction_code(camera)
        changed: Tensor = block(video, memory.tokens, memory.mask, rays, time, memory.codes)
        return changed

    def with_direction_code(self, rays: Float[Tensor, "*batch folded"]) -> Float[Tensor, "*batch coded"]:
        """Return Plücker rays, several as channels, and the code of their directions."""
        if not self.settings.ray_frequencies:
            return rays
        directions = F.normalize(rays.unflatten(-1, (-1, RAY))[..., RAY // 2 :].float(), dim=-1)
        code = position_code(directions, self.settings.ray_frequencies, NARROWEST, WIDEST).flatten(-2)
        return torch.cat([rays, code.to(rays.dtype)], dim=-1)


def token_rays(tokens: MemoryTokens, cameras: Cameras) -> Float[Tensor, "batch frame token 6"]:
    """Return the Plücker ray (o × d, d) from each camera's centre o to each token, d a unit vector.

    Like the rays of the camera condition it is given in the frame of the clip's first camera, in metres.
    """
    first_from_world = invert_rigid(cameras.world_from_camera[:, 0].double())
    centers = transform(first_from_world, cameras.centers.double())[:, :, None]
    direction = F.normalize(transform(first_from_world, tokens.positions)[:, None] - centers, dim=-1)
    moment = torch.linalg.cross(centers.expand_as(direction), direction)
    return torch.cat([moment, direction], dim=-1)
