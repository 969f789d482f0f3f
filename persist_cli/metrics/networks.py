"""What metrics with a network share: its cached weights, loaded once, and how it is run."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

import torch
from torch import Tensor

from persist_cli.errors import CheckpointError
from persist_cli.io.files import read_tensors
from persist_cli.io.hub import cached_weight

Shapes = Mapping[str, tuple[int, ...]]

CHUNK = 16  # frames at once
CPU_PIXELS = 65536  # and at most so many on a CPU: small frames are faster together, of large ones the memory counts


def missing_weights(*names: str) -> str | None:
    """Why a network cannot run when none of its weights is cached, with the command that mends it."""
    if any(cached_weight(name) for name in names):
        return None
    return f"weights {' or '.join(names)} are not here: persist weights fetch {names[0]}"


def network_device() -> torch.device:
    """Where networks run: CUDA when there is any."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def network_weights(name: str, shapes: Shapes) -> dict[str, Tensor]:
    """Tensors of a cached weight on the networks' device, float32, read once a process.

    Raises:
        CheckpointError: when the weight is not cached or its tensors are not those of ``shapes``.
    """
    folder = cached_weight(name)
    if folder is None:
        raise CheckpointError(str(missing_weights(name)))
    return _read(folder / "model.safetensors", tuple(sorted(shapes.items())), network_device())


@lru_cache(maxsize=8)
def _read(file: Path, shapes: tuple[tuple[str, tuple[int, ...]], ...], device: torch.device) -> dict[str, Tensor]:
    tensors, _ = read_tensors(file)
    check_shapes(tensors, dict(shapes), file)
    return {name: tensor.float().to(device) for name, tensor in tensors.items()}


def check_shapes(tensors: Mapping[str, Tensor], shapes: Shapes, file: Path) -> None:
    """Raise ``CheckpointError`` naming the file and the first tensor that is missing, of another shape or unknown."""
    for name, shape in shapes.items():
        found = tuple(tensors[name].shape) if name in tensors else "none"
        if found != shape:
            raise CheckpointError(f"{file}: tensor {name!r} is {found}, wanted {shape}; fetch the weights again")
    unknown = sorted(set(tensors) - set(shapes))
    if unknown:
        raise CheckpointError(f"{file}: unknown tensor {unknown[0]!r}; fetch the weights again")


@contextmanager
def exact_inference() -> Iterator[None]:
    """No gradients, and on CUDA full float32 by deterministic kernels: by default convolutions round to TF32."""
    with (
        torch.inference_mode(),
        torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True, allow_tf32=False),
    ):
        yield


def run_network(network: Callable[..., Tensor], *images: Tensor) -> Tensor:
    """What a network says of each frame, float64 on the CPU.

    Args:
        network: takes a chunk of each of ``images``, gives one row a frame.
        images: the frame first, all with equally many.
    """
    device = network_device()
    chunk = CHUNK if device.type == "cuda" else max(1, min(CHUNK, CPU_PIXELS // math.prod(images[0].shape[1:-1])))
    with exact_inference():
        parts = [
            network(*(part.to(device) for part in chunks)).double().cpu()
            for chunks in zip(*(image.split(chunk) for image in images), strict=True)
        ]
    return torch.cat(parts)
