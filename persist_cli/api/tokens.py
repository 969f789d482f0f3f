"""The tokens that a backbone reads from a memory, with features, positions and a mask."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class MemoryTokens:
    """Memory tokens of one sample, or of a batch of samples.

    Args:
        features: float32 features of the memory's encoder.
        positions: world metres, float64; the backbone moves them into the frame of the clip's first camera.
        mask: true for tokens, false for padding.
    """

    features: Float[Tensor, "*batch token channel"]
    positions: Float[Tensor, "*batch token 3"]
    mask: Bool[Tensor, "*batch token"]

    def __len__(self) -> int:
        return self.features.shape[-2]

    def to(self, device: torch.device | str) -> MemoryTokens:
        """Return these tokens on ``device``."""
        return MemoryTokens(self.features.to(device), self.positions.to(device), self.mask.to(device))

    @staticmethod
    def of(features: Float[Tensor, "token channel"], positions: Float[Tensor, "token 3"]) -> MemoryTokens:
        """Return tokens of one sample without padding; positions are in world metres."""
        return MemoryTokens(
            features.float(), positions.double(), torch.ones(len(features), dtype=torch.bool, device=features.device)
        )

    @staticmethod
    def empty(channels: int) -> MemoryTokens:
        """Return one sample without tokens, whose features would have ``channels`` channels."""
        return MemoryTokens.of(torch.zeros(0, channels), torch.zeros(0, 3))

    @staticmethod
    def stack(samples: Sequence[MemoryTokens]) -> MemoryTokens:
        """Return a batch of unbatched samples, padded to the longest one and to at least one token."""
        width = max(1, *(len(sample) for sample in samples))
        features = samples[0].features.new_zeros(len(samples), width, samples[0].features.shape[-1])
        positions = samples[0].positions.new_zeros(len(samples), width, 3)
        mask = samples[0].mask.new_zeros(len(samples), width)
        for row, sample in enumerate(samples):
            features[row, : len(sample)] = sample.features
            positions[row, : len(sample)] = sample.positions
            mask[row, : len(sample)] = sample.mask
        return MemoryTokens(features, positions, mask)
