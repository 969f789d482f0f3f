"""The machine to train on: how many devices, and how much memory each has."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import psutil
import torch

from persist_cli.errors import PersistError

GIB: Final = 2**30  # as makers of cards say GB
RESERVE: Final = 0.1  # share of a card's memory for its context, the workspaces of kernels and fragmentation


@dataclass(frozen=True)
class Machine:
    """Equal devices that train together.

    Args:
        kind: ``cuda`` or ``cpu``.
        devices: the number of devices.
        memory: bytes of memory of each device.
    """

    kind: str
    devices: int
    memory: int

    @property
    def usable(self) -> int:
        """Bytes of each device that a training may take."""
        return round(self.memory * (1 - RESERVE))

    def __str__(self) -> str:
        name = "GPU" if self.kind == "cuda" else "CPU"
        return f"{self.devices} {name}{'s' if self.devices > 1 else ''} of {self.memory / GIB:.0f} GB"


def gib(size: float) -> str:
    """A number of bytes in GiB, as tables show it."""
    return f"{size / GIB:.3g}" if size < GIB else f"{size / GIB:.1f}"


def machine_of(gpus: int | None, gpu_memory: float | None) -> Machine:
    """The machine of the options ``--gpus`` and ``--gpu-memory``, else the one that this process runs on.

    Args:
        gpus: the number of GPUs; by default those that are here, or one.
        gpu_memory: GB of each GPU, as cards are sold: 2³⁰ bytes. By default that of the first GPU here.

    Raises:
        PersistError: when the memory of the GPUs is not finite, or is not given and there is no GPU here to ask.
    """
    if gpu_memory is not None and not math.isfinite(gpu_memory):
        raise PersistError(f"--gpu-memory {gpu_memory}: give the GB of a card, as in 80")
    here = torch.cuda.device_count()
    if gpus is None and gpu_memory is None and not here:
        return Machine("cpu", 1, memory_here())
    if gpu_memory is None and not here:
        raise PersistError("--gpus: there is no GPU here to know its memory of; give --gpu-memory GB, as in 80")
    memory = torch.cuda.get_device_properties(0).total_memory if gpu_memory is None else round(gpu_memory * GIB)
    return Machine("cuda", gpus or (1 if gpu_memory else here), memory)


def memory_here(proc: Path = Path("/proc/self/cgroup"), groups: Path = Path("/sys/fs/cgroup")) -> int:
    """Return the bytes of memory that this process may use: those of the machine, or of a container or batch job.

    Args:
        proc: the file of Linux that names this process's control group (version 2).
        groups: the folder of all control groups.
    """
    limits: list[int] = [psutil.virtual_memory().total]
    with contextlib.suppress(OSError):
        own = next((line[3:] for line in proc.read_text().splitlines() if line.startswith("0::")), "/")
        group = groups / own.strip("/")
        for folder in (group, *group.parents):
            file = folder / "memory.max"
            limit = file.read_text().strip() if folder.is_relative_to(groups) and file.is_file() else ""
            limits += [int(limit)] if limit.isdigit() else []
    return min(limits)
