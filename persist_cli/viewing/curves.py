"""Curves as PNG."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from persist_cli.world.files import written_aside


def draw_curve(steps: Sequence[float], losses: Sequence[float], path: Path) -> None:
    """The loss of every step in grey and its running mean over a twentieth of the run, on a log scale."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    axes.plot(steps, losses, color="0.8", linewidth=0.8, label="step")
    window = max(1, len(losses) // 20)
    mean = np.convolve(losses, np.ones(window) / window, mode="valid")
    axes.plot(list(steps)[window - 1 :], mean, color="tab:blue", label=f"mean of {window}")
    axes.set(xlabel="optimizer step", ylabel="loss", yscale="log")
    axes.legend()
    with written_aside(path) as aside:
        figure.savefig(aside, format="png", dpi=120)
