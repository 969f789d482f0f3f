"""Checksums in tensor files, and how much is verified when files are read."""

from __future__ import annotations

import contextlib
import json
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from torch import Tensor

CHECKSUM: Final = "checksum"  # its key in the metadata of a tensor file

CRC32: Final = "crc32:"  # how its value begins; CRC-32 is twice as fast as SHA-256 where processors help with both

ALWAYS_VERIFIED: Final = 256 * 2**20  # bytes; a larger file is verified on demand, or loading would take much longer

_everything = False


@contextlib.contextmanager
def verifying(everything: bool) -> Iterator[None]:
    """Within the block every file with a checksum is verified when it is read, else those of moderate size."""
    global _everything
    before, _everything = _everything, everything
    try:
        yield
    finally:
        _everything = before


def is_verified(path: Path) -> bool:
    """Whether a file is to be verified when it is read."""
    return _everything or path.stat().st_size <= ALWAYS_VERIFIED


def tensor_checksum(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> str:
    """The checksum of a tensor file: over names, types, shapes and values of the tensors, and the metadata."""
    return f"{CRC32}{_code(tensors, metadata):08x}"


def _code(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> int:
    """The CRC-32 behind ``tensor_checksum``."""
    rest = {key: value for key, value in metadata.items() if key != CHECKSUM}
    code = zlib.crc32(json.dumps(rest, sort_keys=True).encode())
    for name, tensor in sorted(tensors.items()):
        code = zlib.crc32(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode(), code)
        code = zlib.crc32(tensor_bytes(tensor), code)
    return code


def with_row_checksums(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors, and one more with a checksum of each row, a row being the same place of the first axis of all."""
    import torch

    rows = zip(*tensors.values(), strict=True)
    codes = [_code(dict(zip(tensors, row, strict=True)), {}) for row in rows]
    return {**tensors, CHECKSUM: torch.tensor(codes)}


def is_whole(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> bool:
    """Whether tensors and metadata are those that were written; so they are taken where there is no checksum."""
    stored = metadata.get(CHECKSUM) or next((value for value in metadata.values() if value.startswith(CRC32)), None)
    return stored is None or stored == tensor_checksum(tensors, metadata)


def tensor_bytes(tensor: Tensor) -> memoryview:
    """The bytes of a tensor on the CPU, in the order of its elements."""
    import torch

    return tensor.detach().contiguous().reshape(-1).view(torch.uint8).numpy().data
