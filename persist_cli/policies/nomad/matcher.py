"""Compares the present frame with the goal place by place: it finds again in one image what the other shows."""

from __future__ import annotations

from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from persist_cli.policies.nomad.efficientnet import EfficientNet, EncoderSettings

SHARPNESS: Final = 10.0  # of the softmax over cosines at first
HIDDEN: Final = 256
MATCHES: Final = 128  # numbers that tell of the matches
EACH: Final = 64  # numbers that tell of each image alone


class Matcher(nn.Module):
    """One feature of two images: where each place of the first is found in the second, and what each shows where.

    A mean over a map of features does not tell what is to the left and what to the right, and so not where a goal lies.

    Args:
        settings: sizes of the encoder of both images, whose map has a few dozen places.
        size: height and width of the images in pixels.
    """

    def __init__(self, settings: EncoderSettings, size: tuple[int, int]) -> None:
        super().__init__()
        self.encoder = EfficientNet(settings, 3, 0.0)
        with torch.no_grad():
            places = self.encoder.map(torch.zeros(1, 3, *size)).shape[-2:].numel()
        self.sharpness = nn.Parameter(torch.tensor(SHARPNESS))
        self.matches = nn.Sequential(nn.Linear(places**2, HIDDEN), nn.GELU(), nn.Linear(HIDDEN, MATCHES))
        self.each = nn.Linear(places * settings.head, EACH)
        self.width, self._places = MATCHES + 2 * EACH, places

    def forward(self, pair: Float[Tensor, "batch 6 height width"]) -> Float[Tensor, "batch width"]:
        """Return the feature of two images that lie on top of each other."""
        images = torch.cat(pair.chunk(2, dim=1))
        places = self.encoder.map(images).flatten(2).transpose(1, 2)
        found = self.found(*places.chunk(2)) * self._places**0.5
        return torch.cat([self.matches(found.flatten(1)), *self.each(places.flatten(1)).chunk(2)], dim=1)

    def found(
        self, first: Float[Tensor, "batch place feature"], second: Float[Tensor, "batch place feature"]
    ) -> Float[Tensor, "batch place other"]:
        """Return for each place of the first images how likely it is each place of the second ones."""
        first, second = (functional.normalize(one, dim=-1) for one in (first, second))
        return (self.sharpness * first @ second.transpose(1, 2)).softmax(-1)
