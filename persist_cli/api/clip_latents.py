"""Latents of clips, which a backbone may be given in the place of frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class ClipLatents:
    """Latents of clips, as a backbone's codec encodes them.

    Args:
        video: latents of the whole clips; the frame, height and width axes are those of the codec's latents.
        image: latents of the first frames, each encoded alone.
    """

    video: Float[Tensor, "*batch frame channel height width"]
    image: Float[Tensor, "*batch 1 channel height width"]

    def __getitem__(self, sample: int) -> ClipLatents:
        return ClipLatents(self.video[sample], self.image[sample])

    def to(self, device: torch.device | str) -> ClipLatents:
        """Return these latents on ``device``."""
        return ClipLatents(self.video.to(device), self.image.to(device))

    @staticmethod
    def stack(samples: Sequence[ClipLatents]) -> ClipLatents:
        """Return a batch of the latents of single clips."""
        videos, images = [sample.video for sample in samples], [sample.image for sample in samples]
        return ClipLatents(torch.stack(videos), torch.stack(images))
