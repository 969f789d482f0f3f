"""Networks behind metrics: their cached weights, loaded once, and running them in chunks at full precision."""

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
CPU_PIXELS = 65536  # at once on a CPU: small frames are faster together, large ones would take too much memory


def missing_weights(*names: str) -> str | None:
    """The reason why a network cannot run when none of these weights is cached, with the command that fetches them."""
    if any(cached_weight(name) for name in names):
        return None
    return f"weights {' or '.join(names)} are not here: persist weights fetch {names[0]}"


def network_device() -> torch.device:
    """The device that networks run on: CUDA where there is any."""
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
    check_shapes(tensors, dict(shapes), file, f"delete {file.parent} and fetch the weights again")
    return {name: tensor.float().to(device) for name, tensor in tensors.items()}


def check_shapes(tensors: Mapping[str, Tensor], shapes: Shapes, file: Path, advice: str) -> None:
    """Raise ``CheckpointError`` naming the file and the first tensor that is missing, of another shape or unknown."""
    for name, shape in shapes.items():
        file_shape = tuple(tensors[name].shape) if name in tensors else "none"
        if file_shape != shape:
            raise CheckpointError(f"{file}: tensor {name!r} is {file_shape}, wanted {shape}; {advice}")
    unknown = sorted(set(tensors) - set(shapes))
    if unknown:
        raise CheckpointError(f"{file}: unknown tensor {unknown[0]!r}; {advice}")


@contextmanager
def exact_inference() -> Iterator[None]:
    """Compute without gradients, and on CUDA in full float32 by deterministic kernels.

    By default, convolutions on CUDA would round to TF32.
    """
    with (
        torch.inference_mode(),
        torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True, allow_tf32=False),
    ):
        yield


def run_network(network: Callable[..., Tensor], *images: Tensor) -> Tensor:
    """Run a network on chunks of frames and join its outputs, float64 on the CPU.

    Args:
        network: takes a chunk of each of ``images`` and gives one row for each frame.
        images: tensors whose first axis is the frame, all with equally many frames.
    """
    device = network_device()
    chunk = CHUNK if device.type == "cuda" else max(1, min(CHUNK, CPU_PIXELS // math.prod(images[0].shape[1:-1])))
    with exact_inference():
        parts = [
            network(*(part.to(device) for part in chunks)).double().cpu()
            for chunks in zip(*(image.split(chunk) for image in images), strict=True)
        ]
    return torch.cat(parts)
