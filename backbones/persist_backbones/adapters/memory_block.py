"""The paper's memory block, and the position code of map tokens."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from pydantic import PositiveFloat, PositiveInt
from torch import Tensor, nn

from persist_backbones.adapters.base import AdapterSettings, VideoShape
from persist_backbones.tensors import zero_init
from persist_cli.errors import CheckpointError

RAY = 6  # channels of a Plücker ray

SHORTEST, LONGEST = 0.5, 128.0  # wavelengths of the position code in metres: two cells, twice the paper's map


@dataclass(frozen=True)
class AttentionSettings(AdapterSettings):
    """Settings of the forms that have a memory block after every n-th transformer block.

    Args:
        heads: number of attention heads, a divisor of ``width``.
        frequencies: number of wavelengths of the position code for each axis.
    """

    ff_factor: PositiveFloat = 2.0
    heads: PositiveInt = 4
    frequencies: PositiveInt = 10


class Modulation(NamedTuple):
    """Shift, scale and gate of the expert adaptive layer norm, for video and memory."""

    video_shift: Tensor
    video_scale: Tensor
    video_gate: Tensor
    memory_shift: Tensor
    memory_scale: Tensor
    memory_gate: Tensor


def position_code(
    positions: Float[Tensor, "*batch axis"], frequencies: int, shortest: float = SHORTEST, longest: float = LONGEST
) -> Float[Tensor, "*batch code"]:
    """Encode positions by sine and cosine of each coordinate at geometric wavelengths: axes × 2 × frequencies values.

    Args:
        positions: coordinates, by default in metres.
        frequencies: number of wavelengths for each axis.
        shortest: shortest wavelength, in the unit of the coordinates.
        longest: longest wavelength, in the same unit.
    """
    steps = torch.linspace(0, 1, frequencies, dtype=torch.float64, device=positions.device)
    rates = 2 * math.pi / (shortest * (longest / shortest) ** steps)
    angles = positions.double()[..., None] * rates
    return torch.cat([angles.sin(), angles.cos()], dim=-1).flatten(-2).float()


class MemoryBlock(nn.Module):
    """A block in which the video cross-attends to memory tokens, then a feed-forward; modulated by time (PEWM).

    Gates start at one and the two output projections at zero: a fresh block is the identity to the bit, yet every
    parameter has a gradient after the first step. A gate at zero in front of a zero projection would never learn.

    Args:
        video_channels: channels of the hidden states H.
        camera_channels: channels of the camera embedding, which is concatenated to H in the query.
        width: channels of the memory tokens M and of the attention.
        heads: number of attention heads.
        ff_factor: hidden width of the feed-forward as a multiple of ``video_channels``.
        time_channels: channels of the time embedding t.
    """

    def __init__(
        self, video_channels: int, camera_channels: int, width: int, heads: int, ff_factor: float, time_channels: int
    ) -> None:
        super().__init__()
        self.heads = heads
        self.sizes = [video_channels] * 3 + [width] * 2 + [video_channels]
        self.modulation = nn.Linear(time_channels, sum(self.sizes))
        self.video_norm = nn.LayerNorm(video_channels, elementwise_affine=False)
        self.memory_norm = nn.LayerNorm(width, elementwise_affine=False)
        self.to_query = nn.Linear(video_channels + camera_channels, width)
        self.to_key = nn.Linear(width, width)
        self.to_value = nn.Linear(width, width)
        self.to_out = nn.Linear(width, video_channels)
        self.norm2 = nn.LayerNorm(video_channels)
        hidden = int(video_channels * ff_factor)
        self.ff = nn.Sequential(nn.Linear(video_channels, hidden), nn.GELU("tanh"), nn.Linear(hidden, video_channels))
        self.key_code: nn.Linear | None = None
        zero_init(self.modulation, self.to_out, self.ff[2])

    def add_key_code(self, channels: int) -> None:
        """Concatenate a code of so many channels to M in the keys, not in the values; a fresh one is not zero."""
        self.key_code = nn.Linear(channels, self.to_key.out_features, bias=False)

    def forward(
        self,
        video: Float[Tensor, "batch token channel"],
        memory: Float[Tensor, "batch place width"],
        mask: Bool[Tensor, "batch place"],
        camera: Float[Tensor, "batch token camera"],
        time: Float[Tensor, "batch time"],
        codes: Float[Tensor, "batch frame place code"] | None = None,
    ) -> Float[Tensor, "batch token channel"]:
        """Return H + α_M · CrossAttn(H_n, M_n), then H + α_H · FF(norm2(H)); nothing is attended to without tokens."""
        parts = Modulation(*self.modulation(F.silu(time))[:, None].split(self.sizes, dim=-1))
        query = self.video_norm(video) * (1 + parts.video_scale) + parts.video_shift
        context = self.memory_norm(memory) * (1 + parts.memory_scale) + parts.memory_shift
        attended = self.attend(torch.cat([query, camera.to(query.dtype)], dim=-1), context, mask, codes)
        video = video + (1 + parts.memory_gate) * attended
        changed: Tensor = video + (1 + parts.video_gate) * self.ff(self.norm2(video))
        return changed

    def attend(
        self, query: Tensor, context: Tensor, mask: Bool[Tensor, "batch place"], codes: Tensor | None = None
    ) -> Tensor:
        """Attend to the tokens where the mask is true; the result is exactly zero for a sample that has none.

        Args:
            query: ``[batch, token, channel]``, the tokens of one latent frame after the other.
            context: ``[batch, place, width]``.
            mask: true for tokens that exist.
            codes: what ``add_key_code`` concatenates to the keys, for each latent frame, or one for all of them.
        """
        has_tokens = mask.any(dim=1)
        allowed = mask | ~has_tokens[:, None]  # an all-masked softmax is NaN; these rows are zeroed below
        q, k, v = self.to_query(query), self.to_key(context), self.to_value(context)
        if codes is not None and self.key_code is not None:
            frames = codes.shape[1]
            q, k = q.unflatten(1, (frames, -1)).flatten(0, 1), (k[:, None] + self.key_code(codes)).flatten(0, 1)
            v, allowed = v.repeat_interleave(frames, 0), allowed.repeat_interleave(frames, 0)
        q, k, v = (part.unflatten(-1, (self.heads, -1)).transpose(1, 2) for part in (q, k, v))
        out = F.scaled_dot_product_attention(q, k, v, attn_mask=allowed[:, None, None])
        attended: Tensor = self.to_out(out.transpose(1, 2).flatten(2)).reshape(len(query), query.shape[1], -1)
        return attended * has_tokens[:, None, None]


def memory_blocks(settings: AttentionSettings, video: VideoShape, query_channels: int) -> nn.ModuleDict:
    """Make a memory block for every n-th transformer block, by the number of that block.

    Args:
        settings: sizes of the blocks, and n.
        video: sizes of the video model.
        query_channels: channels that are concatenated to the hidden states in the query.

    Raises:
        CheckpointError: when the heads do not divide the width.
    """
    if settings.width % settings.heads:
        raise CheckpointError(f"adapter: {settings.heads} heads do not divide a width of {settings.width}")
    layers = range(settings.every - 1, video.layers, settings.every)
    sizes = (video.channels, query_channels, settings.width, settings.heads, settings.ff_factor, video.time_channels)
    return nn.ModuleDict({str(layer): MemoryBlock(*sizes) for layer in layers})
