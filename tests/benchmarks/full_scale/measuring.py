"""Seconds and peak memory of works that take turns, and what a device can do at most."""

from __future__ import annotations

import contextlib
import gc
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from tests.support import resident_memory as resident

Work = Callable[[], Any]

PEAKS = {  # dense bf16 FLOP/s by the vendors' datasheets, the most special name first
    "H200 NVL": 835e12,
    "H200": 989e12,
    "H100 PCIe": 756e12,
    "H100 NVL": 835e12,
    "H100": 989e12,
    "A100": 312e12,
    "L40S": 362e12,
    "RTX 4090": 165e12,
    "RTX 3090": 71e12,
}


@dataclass(frozen=True)
class Timing:
    """Runs of one work.

    Args:
        seconds: of each run.
        peak: most bytes of device memory in any of them, on a CPU of resident memory, with all that was held before;
            ``None`` where nobody counts.
    """

    seconds: tuple[float, ...]
    peak: int | None

    @property
    def least(self) -> float:
        """Seconds of the fastest run."""
        return min(self.seconds)

    @property
    def median(self) -> float:
        """Seconds of the run in the middle."""
        return float(np.median(self.seconds))

    def ratio(self, to: Timing) -> float:
        """How many times as long as another, round by round, so that a busy machine slows both."""
        return float(np.median(np.array(self.seconds) / np.array(to.seconds)))


@dataclass
class Turns:
    """Works that take turns; one that does not fit into the device's memory has no timing.

    Args:
        device: whose work is waited for.
        rounds: runs of each work, after one that does not count.
    """

    device: torch.device
    rounds: int

    def measure(self, works: Mapping[str, Work]) -> dict[str, Timing | None]:
        """Timings by name."""
        runs: dict[str, list[tuple[float, int | None]]] = {name: [] for name in works}
        for number in range(self.rounds + 1):
            for name in list(runs):
                found = self.run(works[name])
                if found is None:
                    del runs[name]
                elif number:
                    runs[name].append(found)
        return {name: timing_of(runs[name]) if name in runs else None for name in works}

    def run(self, work: Work) -> tuple[float, int | None] | None:
        """Seconds of one run and the most memory that was held in it; ``None`` when it does not fit."""
        with contextlib.suppress(torch.OutOfMemoryError):
            return self.timed(work)
        release(self.device)  # only here, where the error no longer holds what the work had made
        return None

    def timed(self, work: Work) -> tuple[float, int | None]:
        """Seconds of one run and the most memory that was held in it."""
        forget_peak(self.device)
        synchronize(self.device)
        start = time.perf_counter()
        work()
        synchronize(self.device)
        return time.perf_counter() - start, peak_memory(self.device)


def timing_of(runs: Sequence[tuple[float, int | None]]) -> Timing:
    """Of the seconds and the peak memory of each run."""
    peaks = [peak for _, peak in runs if peak is not None]
    return Timing(tuple(seconds for seconds, _ in runs), max(peaks, default=None))


def synchronize(device: torch.device) -> None:
    """Wait until the device has done what it was asked."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def release(device: torch.device) -> None:
    """Give back memory that nothing holds any more."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()


def forget_peak(device: torch.device) -> None:
    """Begin to look for the most memory anew."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    elif resident.KNOWN:
        resident.forget_peak()


def peak_memory(device: torch.device) -> int | None:
    """The most bytes held since ``forget_peak``; ``None`` where nobody counts."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    return resident.peak_resident() if resident.KNOWN else None


def device_name(device: torch.device) -> str:
    """What the device calls itself."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"CPU, {torch.get_num_threads()} thread(s)"


def peak_flops(device: torch.device, precision: torch.dtype) -> tuple[float, str]:
    """FLOP/s that the device can do at most, and where the figure is from."""
    if device.type == "cuda" and precision == torch.bfloat16:
        for name, peak in PEAKS.items():
            if name in device_name(device):
                return peak, f"datasheet of the {name}, dense bf16"
    return matmul_flops(device, precision), "measured by a matrix product"


def matmul_flops(device: torch.device, precision: torch.dtype) -> float:
    """FLOP/s of large square matrix products, the fastest of ten."""
    side = 8192 if device.type == "cuda" else 1024
    one, other = (torch.randn(side, side, device=device, dtype=precision) for _ in range(2))
    timing = Turns(device, 10).measure({"product": lambda: one @ other})["product"]
    return 2 * side**3 / timing.least if timing else float("nan")
