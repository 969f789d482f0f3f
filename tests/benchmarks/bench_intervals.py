"""How often the 95 % intervals of `persist eval` hold what they should, in simulated cases.

    python tests/benchmarks/bench_intervals.py

Prints, each of ``--cases`` cases: how often the interval over scenes holds the true mean of normal values and of
shares; how often the interval of a difference leaves zero out where two rows of three trainings differ by chance alone,
in their trainings and in nothing else; and the mean of ``psnr-fall`` of rollouts that do not fade. Asserts nothing.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_cli.evaluate.statistics import Array, Draws
from persist_cli.output.console import print_table

SCENES = 3, 5, 6, 10, 16, 32
MODELS = 3
WINDOWS, LEVEL, DEVIATION = 10, 20.0, 2.0  # of a rollout: windows, PSNR in dB, its deviation in a window of a clip


def ends(drawn: Array) -> tuple[Array, Array]:
    """Ends of the interval of each case, from ``[case, resample]``."""
    low, high = np.quantile(drawn, (0.025, 0.975), axis=1)
    return low, high


def held(values: Array, truth: float) -> float:
    """Share of the cases ``[case, scene]`` whose interval over scenes holds the true mean."""
    drawn = Draws.of(range(values.shape[1])).clips
    low, high = ends(values @ drawn.T / drawn.sum(axis=1))
    return float(((low <= truth) & (truth <= high)).mean())


def left_out(first: Array, second: Array) -> float:
    """Share of the cases ``[case, model]`` where the interval of the difference of two rows leaves zero out."""
    means = []
    for row, values in zip("ab", (first, second), strict=True):
        drawn = Draws.of([0], [f"{row}{number}" for number in range(values.shape[1])]).models
        means.append(values @ drawn.T / drawn.sum(axis=1))
    low, high = ends(means[0] - means[1])
    return float(((low > 0) | (high < 0)).mean())


def fall(generator: np.random.Generator, cases: int, clips: int) -> float:
    """Mean ``psnr-fall`` of rollouts whose windows differ by chance alone."""
    curves = generator.normal(LEVEL, DEVIATION, (cases, clips, WINDOWS)).mean(axis=1)
    best = curves.max(axis=1)
    return float(((best - curves.min(axis=1)) / best).mean())


def main() -> None:
    """Simulate and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    cases, generator = options.cases, np.random.default_rng(options.seed)
    rows = []
    for scenes in SCENES:
        share = held(generator.normal(size=(cases, scenes)), 0.0)
        rows.append((f"normal values of {scenes} scenes: the interval holds the mean", f"{share:.0%}"))
    shares = (generator.random((cases, 37)) < 0.95).astype(np.float64)
    rows.append(("95 % successes in 37 scenes: the interval holds the share", f"{held(shares, 0.95):.0%}"))
    share = left_out(*generator.normal(size=(2, cases, MODELS)))
    rows.append((f"two rows of {MODELS} trainings, equal but for chance: zero is left out", f"{share:.0%}"))
    for clips in (8, 32):
        rows.append((f"psnr-fall of {clips} clips that do not fade", f"{fall(generator, cases, clips):.2f}"))
    print_table("", ["case", "figure"], rows)


if __name__ == "__main__":
    main()
