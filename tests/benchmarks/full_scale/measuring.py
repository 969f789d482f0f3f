"""Seconds and peak memory of functions that take turns, and the peak FLOP/s of a device."""

from __future__ import annotations

import contextlib
import gc
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from tests.support import resident_memory

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

SIDES = {"cuda": 8192, "cpu": 1024}  # of the square matrices whose product measures a device


@dataclass(frozen=True)
class Timing:
    """Runs of one function.

    Args:
        seconds: seconds of each run.
        peak: largest number of bytes held in any run, those held before included: device memory, on a CPU resident
            memory; ``None`` where it cannot be measured.
    """

    seconds: tuple[float, ...]
    peak: int | None

    @property
    def least(self) -> float:
        """Seconds of the fastest run."""
        return min(self.seconds)

    @property
    def median(self) -> float:
        """The median seconds of a run."""
        return float(np.median(self.seconds))

    def ratio(self, to: Timing) -> float:
        """The median, over the rounds, of these seconds over another's, so that a busy machine slows both."""
        return float(np.median(np.array(self.seconds) / np.array(to.seconds)))


@dataclass
class Turns:
    """Runs functions in turns; one that does not fit into the device's memory has no timing.

    Args:
        device: device that the functions compute on.
        rounds: runs of each function, after a warm-up that does not count.
    """

    device: torch.device
    rounds: int

    def measure(self, works: Mapping[str, Work]) -> dict[str, Timing | None]:
        """Run every function once a round; returns their timings by name."""
        runs: dict[str, list[tuple[float, int | None]]] = {name: [] for name in works}
        for number in range(self.rounds + 1):
            for name in list(runs):
                result = self.run(works[name])
                if result is None:
                    del runs[name]
                elif number:
                    runs[name].append(result)
        return {name: timing_of(runs[name]) if name in runs else None for name in works}

    def run(self, work: Work) -> tuple[float, int | None] | None:
        """Seconds of one run and the most memory that was held in it; ``None`` when it does not fit."""
        with contextlib.suppress(torch.OutOfMemoryError):
            return self.timed(work)
        release(self.device)  # not before: the error held what the function had allocated
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
    """The timing of some runs, of each of which the seconds and the peak memory are given."""
    peaks = [peak for _, peak in runs if peak is not None]
    return Timing(tuple(seconds for seconds, _ in runs), max(peaks, default=None))


def synchronize(device: torch.device) -> None:
    """Wait until the device has finished its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def release(device: torch.device) -> None:
    """Return memory that is no longer used."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()


def forget_peak(device: torch.device) -> None:
    """Measure the peak memory from now on."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    elif resident_memory.KNOWN:
        resident_memory.forget_peak()


def peak_memory(device: torch.device) -> int | None:
    """The largest number of bytes held since ``forget_peak``; ``None`` where it cannot be measured."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    return resident_memory.peak_resident() if resident_memory.KNOWN else None


def device_name(device: torch.device) -> str:
    """The name of the device."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"CPU, {torch.get_num_threads()} thread(s)"


def peak_flops(device: torch.device, precision: torch.dtype) -> tuple[float, str]:
    """The peak FLOP/s of the device, and the source of the figure."""
    if device.type == "cuda" and precision == torch.bfloat16:
        for name, peak in PEAKS.items():
            if name in device_name(device):
                return peak, f"datasheet of the {name}, dense bf16"
    # a CPU without units for bf16 multiplies its matrices far slower than all else that a model does in bf16
    return max(matmul_flops(device, kind) for kind in {precision, torch.float32}), "measured by a matrix product"


def matmul_flops(device: torch.device, precision: torch.dtype) -> float:
    """FLOP/s of large square matrix products, the fastest of ten."""
    side = SIDES.get(device.type, SIDES["cpu"])
    first, second = (torch.randn(side, side, device=device, dtype=precision) for _ in range(2))
    timing = Turns(device, 10).measure({"product": lambda: first @ second})["product"]
    return 2 * side**3 / timing.least if timing else float("nan")
