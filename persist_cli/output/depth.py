"""Depth in colours of one scale, and the bar that says how many metres a colour means."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw
from torch import Tensor

from persist_cli.output.sheet import label_font

COLORS = "turbo_r"  # of matplotlib: near is dark red, far dark blue
OUTLIERS = 0.02  # part of the pixels that may be nearer than the scale's near end, and farther than its far end
MOST_PIXELS = 1_000_000  # that the ends are computed from
BAR = 10  # pixels of the height of the colours
BAR_HEIGHT = 30  # pixels, with the figures below
TICKS = 5
TICK_WIDTH = 64  # pixels that the figures of one tick need


@dataclass(frozen=True)
class DepthScale:
    """The depths at both ends of the colours; what is nearer or farther has the colour of that end.

    Args:
        near: metres.
        far: metres.
    """

    near: float
    far: float

    @staticmethod
    def of(depths: Sequence[Float[Tensor, "frame height width"]]) -> DepthScale:
        """Return the scale of all these depths in metres, 0 = missing, but for 2 % of the pixels at each end."""
        known = torch.cat([depth.flatten() for depth in depths]).float()
        known = known[known > 0]
        if not len(known):
            return DepthScale(0.0, 1.0)
        known = known[:: -(-len(known) // MOST_PIXELS)]
        near, far = torch.quantile(known, torch.tensor([OUTLIERS, 1 - OUTLIERS])).tolist()
        return DepthScale(near, max(far, near + 1e-3))

    def color(self, depth: Float[Tensor, "frame height width"]) -> UInt8[Tensor, "frame height width 3"]:
        """Return depth in metres as colours from near (dark red) to far (dark blue), missing depth in black."""
        from matplotlib import colormaps

        places = ((depth - self.near) / (self.far - self.near)).clamp(0, 1).numpy()
        colors = colormaps[COLORS](places)[..., :3]
        colors[depth.numpy() <= 0] = 0
        return torch.from_numpy((colors * 255).astype(np.uint8))

    def bar(self, width: int) -> UInt8[Tensor, "height width 3"]:
        """Return the colours from near to far with their metres below, ``width`` pixels wide."""
        places = torch.linspace(self.near, self.far, width)
        strip = np.full((BAR_HEIGHT, width, 3), 255, np.uint8)
        strip[2 : 2 + BAR] = self.color(places.clamp_min(1e-6)[None, None]).numpy()[0]
        picture = Image.fromarray(strip)
        draw, font = ImageDraw.Draw(picture), label_font(10)
        count = max(2, min(TICKS, width // TICK_WIDTH))
        for number in range(count):
            place = number / (count - 1)
            text = f"{self.near + place * (self.far - self.near):.2f} m"
            left = place * (width - 1) - place * font.getlength(text)
            draw.text((left, BAR + 4), text, fill="black", font=font)
        return torch.from_numpy(np.array(picture))

    def to_json(self) -> dict[str, Any]:
        """Return both ends in metres."""
        return {"near_metres": self.near, "far_metres": self.far}
