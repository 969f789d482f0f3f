"""Samples on their way from a process that reads data to the one that trains, with all their tensors in one.

Each tensor that one process hands another costs a file descriptor and about a millisecond, so that a batch of many
small tensors would take longer to hand over than to read.
"""

from __future__ import annotations

import io
import math
import os
import pickle
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import torch
from torch import Tensor
from torch.utils.data import get_worker_info

from persist_cli.errors import PersistError

ALIGNMENT: Final = 16  # bytes; the largest element of a tensor


class Place(NamedTuple):
    """Where a tensor's bytes lie among those of all: first byte, type and shape."""

    start: int
    kind: torch.dtype
    shape: tuple[int, ...]


class PackedSamples(NamedTuple):
    """Samples without their tensors, the bytes of these, and where each lies among them."""

    samples: bytes
    tensors: Tensor
    places: list[Place]


class _Packer(pickle.Pickler):
    """Pickles values and keeps their tensors apart."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file, protocol=pickle.HIGHEST_PROTOCOL)
        self.tensors: list[Tensor] = []

    def persistent_id(self, value: Any) -> int | None:
        """The number of a tensor, ``None`` for all else, which is pickled."""
        if not isinstance(value, Tensor):
            return None
        self.tensors.append(value.contiguous())
        return len(self.tensors) - 1


class _Unpacker(pickle.Unpickler):
    """Reads what this program's own process packed, and gives tensors that share one's memory."""

    def __init__(self, packed: PackedSamples) -> None:
        super().__init__(io.BytesIO(packed.samples))
        self.tensors, self.places = packed.tensors, packed.places

    def persistent_load(self, number: int) -> Tensor:
        """The tensor of this number."""
        start, kind, shape = self.places[number]
        size = kind.itemsize * torch.Size(shape).numel()
        return self.tensors[start : start + size].view(kind).view(shape)


def pack(samples: Sequence[Any]) -> PackedSamples:
    """Pack samples whose tensors are on the CPU."""
    file = io.BytesIO()
    packer = _Packer(file)
    packer.dump([*samples])
    places, end = [], 0
    for tensor in packer.tensors:
        places.append(Place(end, tensor.dtype, tuple(tensor.shape)))
        end += -(-tensor.nbytes // ALIGNMENT) * ALIGNMENT
    together = torch.empty(end, dtype=torch.uint8)
    for tensor, place in zip(packer.tensors, places, strict=True):
        together[place.start : place.start + tensor.nbytes] = tensor.view(-1).view(torch.uint8)
    return PackedSamples(file.getvalue(), together, places)


def pack_shared(samples: Sequence[Any]) -> PackedSamples:
    """Pack samples into memory that processes share; a ``PersistError`` stands in their place where it has no room.

    When torch puts them there, as it sends them, it drops those that find no room, and they are waited for without end.
    """
    packed = pack(samples)
    try:
        packed.tensors.share_memory_()
    except RuntimeError as error:
        return pack([PersistError(no_room(packed.tensors.nbytes, error))])
    return packed


def no_room(size: int, error: RuntimeError) -> str:
    """Say that a batch of so many bytes finds no room in shared memory, and how much there should be."""
    info = get_worker_info()
    workers = info.num_workers if info is not None else 1
    batches = (2 * workers + 2) * int(os.environ.get("LOCAL_WORLD_SIZE", "1"))  # torch reads two a process ahead
    cause = str(error).rsplit(": ", 1)[-1]
    return (
        f"a batch of {size / 1e6:,.1f} MB finds no room in shared memory, /dev/shm ({cause}); {batches} may be there "
        f"at once: run the container with --ipc=host or --shm-size={math.ceil(batches * size / 1e9)}g, elsewhere "
        "enlarge it, or train with fewer training.workers (0 needs none)"
    )


def unpack(packed: PackedSamples) -> list[Any]:
    """The samples that were packed; their tensors share memory, and none may be changed."""
    samples: list[Any] = _Unpacker(packed).load()
    return samples
