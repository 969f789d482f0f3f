"""safetensors files whose tensors are not aligned, as those of another writer may be."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from safetensors.torch import load_file
from torch import Tensor, nn

ALIGNMENT = 64  # bytes, of memory that torch allocates on a CPU


def write_misaligned(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Write tensors so that none of them begins at a multiple of eight bytes."""
    header: dict[str, object] = {"__metadata__": {"format": "pt"}}
    data = b""
    for name, tensor in sorted(tensors.items(), key=lambda pair: -pair[1].element_size()):
        values = tensor.detach().contiguous().numpy().tobytes()
        place = [len(data), len(data) + len(values)]
        header[name] = {"dtype": f"F{8 * tensor.element_size()}", "shape": list(tensor.shape), "data_offsets": place}
        data += values
    text = json.dumps(header).encode()
    text += b" " * ((8 - len(text)) % 16)  # the data begin at an odd multiple of eight bytes
    path.write_bytes(len(text).to_bytes(8, "little") + text + data)


def misalign(path: Path) -> None:
    """Write a file of tensors again so that they are not aligned."""
    write_misaligned(path, {name: tensor.clone() for name, tensor in load_file(path).items()})


def misaligned(module: nn.Module) -> list[str]:
    """Weights that do not lie as torch's own do."""
    named = (*module.named_parameters(), *module.named_buffers())
    return [name for name, tensor in named if tensor.data_ptr() % ALIGNMENT]
