"""Likeness of a return to the video's own first visit, pixel by pixel, where both see the same surface.

SRC compares features, which fog shares with fog and which forgive where things are. Here the generated frame of the
first visit is brought into the view of the return by the true depth and poses, as in the warping error of video
consistency (Lai et al. 2018), and compared with what the video shows on return.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from persist_cli.metrics.lpips import LpipsAlex, perceptual_distance, tensor_shapes
from persist_cli.metrics.metric import FrameMetric, Prediction, Setup
from persist_cli.metrics.networks import network_weights, run_network
from persist_cli.metrics.return_views import match_views
from persist_cli.metrics.src import no_match, no_return

LEAST_SEEN = 0.25  # share of the view: with less there is little to compare, and LPIPS, 0 where nothing is, is too good

VIEWS = (
    "at each frame that returns to an earlier pose over more than one predicted clip and sees there again at least "
    f"{LEAST_SEEN:.0%} of its view, against the generated frame of its first visit, brought into the view by true "
    "depth and poses"
)


class PsnrOwn(FrameMetric):
    """PSNR of the return to the video's own first visit."""

    name = "psnr-own"
    title = "PSNR to own first visit"
    better = "higher"
    compares_with_truth = False
    definition = f"dB {VIEWS}, over the pixels that both see; an exact copy counts as 100"

    def obstacle(self, setup: Setup) -> str | None:
        """The reason when no clip returns, or no depth says which pixels match."""
        return no_return(setup) or no_match(setup)

    def measure(self, prediction: Prediction) -> Float[Tensor, " frame"]:
        """The ratio at each frame that returns and sees enough again, NaN at the others."""
        figures = torch.full((len(prediction.rgb),), math.nan, dtype=torch.float64)
        for frame, visit, known in seen_again(prediction):
            error = (prediction.rgb[frame].double() - visit).square()[known].mean()
            figures[frame] = (10 * torch.log10(255.0**2 / error)).clamp_max(100.0)
        return figures


class LpipsOwn(LpipsAlex):
    """LPIPS of the return to the video's own first visit."""

    name = "lpips-own"
    title = "LPIPS to own first visit"
    compares_with_truth = False
    weights = (LpipsAlex.name,)

    @property
    def definition(self) -> str:
        """A sentence with the views that are compared and the network."""
        return f"LPIPS {VIEWS}; pixels that both do not see are the truth's in both images; {super().definition}"

    def obstacle(self, setup: Setup) -> str | None:
        """The reason when no clip returns, no depth says which pixels match, or LPIPS cannot be measured."""
        return no_return(setup) or no_match(setup) or LpipsAlex().obstacle(setup)

    def measure(self, prediction: Prediction) -> Float[Tensor, " frame"]:
        """The distance at each frame that returns and sees enough again, NaN at the others."""
        figures = torch.full((len(prediction.rgb),), math.nan, dtype=torch.float64)
        frames, pairs = [], []
        for frame, visit, known in seen_again(prediction):
            frames.append(frame)
            truth = prediction.truth.rgb[frame].cpu().double()
            pairs.append([torch.where(known[..., None], image, truth) for image in (prediction.rgb[frame], visit)])
        if pairs:
            weights = network_weights(LpipsAlex.name, tensor_shapes(self.network))
            images = [torch.stack(side).round().to(torch.uint8) for side in zip(*pairs, strict=True)]
            figures[frames] = run_network(
                lambda one, two: perceptual_distance(weights, self.network, one, two), *images
            )
        return figures


def seen_again(
    prediction: Prediction,
) -> Iterator[tuple[int, Float[Tensor, "height width 3"], Bool[Tensor, "height width"]]]:
    """Each frame that returns and sees enough again: its number, and what ``first_visit`` gives of it."""
    for frame, first in prediction.returns:
        visit, known = first_visit(prediction, frame, first)
        if known.double().mean() >= LEAST_SEEN:
            yield frame, visit, known


def first_visit(
    prediction: Prediction, frame: int, first: int
) -> tuple[Float[Tensor, "height width 3"], Bool[Tensor, "height width"]]:
    """The generated frame of the first visit in the view of the return, 0 to 255, and which pixels both see.

    Args:
        prediction: the video.
        frame: number of the frame that returns.
        first: number of the frame of the first visit.
    """
    match = match_views(prediction.truth.to("cpu"), frame, first)
    earlier: UInt8[Tensor, "height width 3"] = prediction.rgb[first].cpu()
    return match.sample(earlier.permute(2, 0, 1).double()).permute(1, 2, 0), match.known
