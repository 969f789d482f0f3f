"""What a memory gives a backbone: tokens with features, positions and a mask."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class MemoryTokens:
    """Memory tokens, of one sample or a batch of them.

    Args:
        features: float32.
        positions: world metres, float64; the backbone expresses them relative to its first camera.
        mask: false for padding.
    """

    features: Float[Tensor, "*batch token channel"]
    positions: Float[Tensor, "*batch token 3"]
    mask: Bool[Tensor, "*batch token"]

    def __len__(self) -> int:
        return self.features.shape[-2]

    def to(self, device: torch.device | str) -> MemoryTokens:
        """The same tokens on ``device``."""
        return MemoryTokens(self.features.to(device), self.positions.to(device), self.mask.to(device))

    @staticmethod
    def of(features: Float[Tensor, "token channel"], positions: Float[Tensor, "token 3"]) -> MemoryTokens:
        """Tokens of one sample, none of them padding."""
        return MemoryTokens(
            features.float(), positions.double(), torch.ones(len(features), dtype=torch.bool, device=features.device)
        )

    @staticmethod
    def empty(channels: int) -> MemoryTokens:
        """No token at all."""
        return MemoryTokens.of(torch.zeros(0, channels), torch.zeros(0, 3))

    @staticmethod
    def stack(samples: Sequence[MemoryTokens]) -> MemoryTokens:
        """A batch, shorter samples padded behind the mask; at least one token wide."""
        width = max(1, *(len(sample) for sample in samples))
        features = samples[0].features.new_zeros(len(samples), width, samples[0].features.shape[-1])
        positions = samples[0].positions.new_zeros(len(samples), width, 3)
        mask = samples[0].mask.new_zeros(len(samples), width)
        for row, sample in enumerate(samples):
            features[row, : len(sample)] = sample.features
            positions[row, : len(sample)] = sample.positions
            mask[row, : len(sample)] = sample.mask
        return MemoryTokens(features, positions, mask)
