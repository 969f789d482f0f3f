"""Samples on their way from a process that reads data to the one that trains, with all their tensors in one.

Each tensor that one process hands another costs a file descriptor and about a millisecond, so that a batch of many
small tensors would take longer to hand over than to read.
"""

from __future__ import annotations

import io
import pickle
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import torch
from torch import Tensor

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


def unpack(packed: PackedSamples) -> list[Any]:
    """The samples that were packed; their tensors share memory, and none may be changed."""
    samples: list[Any] = _Unpacker(packed).load()
    return samples
