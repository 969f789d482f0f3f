"""What a canvas adds to the model's prediction, at each latent pixel."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from persist_backbones.zero_init import zero_init


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
