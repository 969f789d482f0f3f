"""Two views of one place, matched pixel by pixel by true depth and poses: where a return sees its first visit again."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from persist_cli.api.geometry import find_in_views, unproject
from persist_cli.api.observations import Observations


@dataclass(frozen=True)
class Match:
    """The places of a view's pixels in another view.

    Args:
        places: column and row of each pixel in the other image, in pixels, the centre of the first one at 0.5.
        known: whether the other view sees the pixel's surface.
    """

    places: Float[Tensor, "height width 2"]
    known: Bool[Tensor, "height width"]

    def sample(self, image: Float[Tensor, "channel rows columns"]) -> Float[Tensor, "channel height width"]:
        """The other view's image, or features of it, at the places, linearly between its pixels.

        Args:
            image: covers the other view evenly, at any resolution.
        """
        height, width = self.known.shape
        size = torch.tensor([width, height], dtype=torch.float64)
        grid = (2 * self.places / size - 1).to(image.dtype)
        return torch.nn.functional.grid_sample(image[None], grid[None], padding_mode="border", align_corners=False)[0]


def match_views(truth: Observations, frame: int, first: int) -> Match:
    """Match the pixels of a frame with those of an earlier one that shows the same surfaces.

    Args:
        truth: true frames with depth on the CPU.
        frame: number of the frame whose pixels are matched.
        first: number of the earlier frame.
    """
    seen, earlier = truth[[frame]], truth[[first]]
    height, width = seen.depth.shape[1:]
    points = unproject(seen.depth, seen.cameras).reshape(1, -1, 3)
    places, known = find_in_views(points, earlier.depth, earlier.cameras)
    return Match(places.nan_to_num(-1.0).reshape(height, width, 2), known.reshape(height, width) & (seen.depth[0] > 0))
