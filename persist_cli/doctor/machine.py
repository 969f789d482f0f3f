"""The machine that a training is planned for: how many devices, and how much memory each has."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import Final

import torch

from persist_cli.errors import PersistError

GIB: Final = 2**30  # as makers of cards say GB
RESERVE: Final = 0.1  # of a card's memory that is not planned with: its context, kernels' workspaces, fragmentation


@dataclass(frozen=True)
class Machine:
    """Like devices that train together.

    Args:
        kind: ``cuda`` or ``cpu``.
        devices: how many.
        memory: bytes of each.
    """

    kind: str
    devices: int
    memory: int

    @property
    def usable(self) -> int:
        """Bytes of each device to plan with."""
        return round(self.memory * (1 - RESERVE))

    def __str__(self) -> str:
        name = "GPU" if self.kind == "cuda" else "CPU"
        return f"{self.devices} {name}{'s' if self.devices > 1 else ''} of {self.memory / GIB:.0f} GB"


def gib(size: float) -> str:
    """Bytes in GiB, as tables have them."""
    return f"{size / GIB:.3g}" if size < GIB else f"{size / GIB:.1f}"


def machine_of(gpus: int | None, gpu_memory: float | None) -> Machine:
    """GPUs that are asked for, of the size of those here where none is given; else what is here.

    Args:
        gpus: how many.
        gpu_memory: GB of each, as cards are called: 2³⁰ bytes.

    Raises:
        PersistError: when GPUs are asked for, none is here and their memory is not given, and when it is no number.
    """
    if gpu_memory is not None and not math.isfinite(gpu_memory):
        raise PersistError(f"--gpu-memory {gpu_memory}: give the GB of a card, as in 80")
    here = torch.cuda.device_count()
    if gpus is None and gpu_memory is None and not here:
        return Machine("cpu", 1, os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    if gpu_memory is None and not here:
        raise PersistError("--gpus: there is no GPU here to know its memory of; give --gpu-memory GB, as in 80")
    memory = torch.cuda.get_device_properties(0).total_memory if gpu_memory is None else round(gpu_memory * GIB)
    return Machine("cuda", gpus or (1 if gpu_memory else here), memory)
