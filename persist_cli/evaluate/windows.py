"""Windows along a rollout that lives on its own output: does it fade, blur, or fill its map without end?

Means over windows of eight frames show how a rollout goes on. Three figures of these curves stand in the table: how far
the worst of ten windows falls below the best, LPIPS at the end beside that at frame 16, and the sharpness of the worst
window, without which fog would count as stable. They are figures of the mean curve over all clips, since the windows of
a single clip differ by what they look at.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from persist_cli.evaluate.statistics import Array, Counts

WINDOW = 8  # frames

SHOWN = ("psnr", "lpips-alex", "sharpness", "grain")  # metrics whose windows are kept

TENTHS = 10  # windows of the fall from the best to the worst

EARLY = range(9, 17)  # frames before and at frame 16

LEAST_FRAMES = 24  # predicted frames of a rollout whose end is compared with its frame 16


@dataclass(frozen=True)
class CurveColumn:
    """A figure of a metric's curve over windows.

    Args:
        suffix: end of the column's name, behind the metric's.
        title: heading of the column.
        better: ``higher`` or ``lower``.
        definition: what it says, over which windows.
        windows: numbers of the frames of each window, of a clip with so many frames.
        figure: takes mean curves ``[curve, window]`` and gives a number for each.
    """

    suffix: str
    title: str
    better: str
    definition: str
    windows: Callable[[int], list[Counts]]
    figure: Callable[[Array], Array]


def window_bounds(frames: int, length: int = WINDOW) -> list[tuple[int, int]]:
    """First and last predicted frame of each window of a clip; the last window may be shorter.

    Args:
        frames: length of the clip, the given frame included.
        length: frames of a window.
    """
    return [(first, min(first + length, frames) - 1) for first in range(1, frames, length)]


def windows_of(frames: int) -> list[Counts]:
    """Numbers of the predicted frames of each window of a clip.

    Args:
        frames: length of the clip, the given frame included.
    """
    return [np.arange(first, last + 1, dtype=np.int64) for first, last in window_bounds(frames)]


def tenths_of(frames: int) -> list[Counts]:
    """Numbers of the predicted frames of ten windows of nearly equal lengths."""
    return list(np.array_split(np.arange(1, frames, dtype=np.int64), min(TENTHS, frames - 1)))


def ends_of(frames: int) -> list[Counts]:
    """Numbers of the eight frames up to frame 16, and of the last eight; none of a clip of fewer than 24 predicted."""
    if frames - 1 < LEAST_FRAMES:
        return [np.zeros(0, np.int64)] * 2
    return [np.array(EARLY, np.int64), np.arange(frames - WINDOW, frames, dtype=np.int64)]


def fall(curves: Array) -> Array:
    """(best − worst) / best of curves ``[curve, window]`` of which higher is better."""
    best = np.fmax.reduce(curves, axis=1)
    lost: Array = (best - np.fmin.reduce(curves, axis=1)) / best
    return lost


def growth(curves: Array) -> Array:
    """The last window over the first; NaN where the first is 0, as of a rollout that is right to the bit."""
    first, last = curves[:, 0], curves[:, -1]
    ratio: Array = np.divide(last, first, out=np.full_like(last, np.nan), where=first > 0)
    return ratio


def least(curves: Array) -> Array:
    """The least window."""
    worst: Array = np.fmin.reduce(curves, axis=1)
    return worst


CURVE_COLUMNS: dict[str, CurveColumn] = {
    "psnr": CurveColumn(
        "-fall", " fall", "lower",
        f"(best − worst) / best of the means over {TENTHS} windows of equal length along the clip; 0 is no drift",
        tenths_of, fall,
    ),
    "lpips-alex": CurveColumn(
        "-growth", " end / frame 16", "lower",
        f"mean over the last {WINDOW} frames over that of frames {EARLY[0]} to {EARLY[-1]}; 1 is no drift",
        ends_of, growth,
    ),
    "sharpness": CurveColumn(
        "-least", " worst window", "higher", f"the least of the windows of {WINDOW} frames; fog is stable too",
        windows_of, least,
    ),
}  # fmt: skip


def window_values(values: Array, weights: Array, windows: Sequence[Counts]) -> tuple[Array, Array]:
    """Means of the known frames of each window, and the weights of these means.

    Args:
        values: ``[…, frame]``, NaN where there is none.
        weights: how much each frame counts, of the same shape.
        windows: numbers of the frames of each window.

    Returns:
        Both ``[…, window]``.
    """
    known = np.isfinite(values) & (weights > 0)
    counted, sums = np.where(known, weights, 0.0), np.where(known, np.nan_to_num(values) * weights, 0.0)
    totals = np.stack([counted[..., window].sum(-1) for window in windows], axis=-1)
    summed = np.stack([sums[..., window].sum(-1) for window in windows], axis=-1)
    return np.where(totals > 0, summed / np.where(totals > 0, totals, 1.0), np.nan), totals
