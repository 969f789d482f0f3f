"""Memory files read back into memories, with the paths that they keep."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from persist_cli.api.memory import PATH, FrameOfReference, Memory
from persist_cli.api.memory_file import read_header
from persist_cli.errors import CheckpointError, PersistError
from persist_cli.io.files import read_tensors
from persist_cli.memorize.imagining import with_scene_model
from persist_cli.plugins import make_encoder, make_memory


def load_memory(path: Path) -> Memory:
    """Return the memory that ``Memory.save`` wrote, with its encoder, on the CPU; a scene has its model.

    Raises:
        CheckpointError: when the file cannot be used; one line names the file and the cause.
        PluginError: when the plugin of its memory or encoder is not installed.
    """
    header = read_header(path)
    tensors = {name: tensor for name, tensor in read_tensors(path)[0].items() if not name.startswith(PATH)}
    x, y, z = header["world_up"]
    try:
        encoder = make_encoder(header["encoder"], header["encoder_settings"])
        reference = FrameOfReference(header["reference"], (x, y, z))
        memory = make_memory(header["memory"], header["settings"], encoder, reference)
        if encoder.channels != header["channels"]:
            raise CheckpointError(
                f"written with {header['channels']} channels, but encoder {header['encoder']!r} now has "
                f"{encoder.channels}; build the memory anew"
            )
        with_scene_model(memory).restore(tensors)
    except PersistError as error:
        raise type(error)(f"{path}: {error}") from error
    restored = memory.figures().cells
    if restored != header["cells"]:
        raise CheckpointError(
            f"{path}: memory {memory.name!r} restored {restored} cells, the header says {header['cells']}; the file is "
            "damaged, or restore() forgets what tensors() gave"
        )
    return memory


def load_paths(path: Path) -> dict[str, Float[Tensor, "frame 4 4"]]:
    """Return world_from_camera of the paths that a memory file keeps for its map, by name; version 1 has none.

    Raises:
        CheckpointError: when the file is no memory, or a path in it is none of finite poses.
    """
    from safetensors import safe_open

    read_header(path)
    with safe_open(path, framework="pt") as file:
        names = file.keys()  # the file is no dictionary
        paths = {name.removeprefix(PATH): file.get_tensor(name) for name in names if name.startswith(PATH)}
    for name, poses in paths.items():
        if poses.shape[1:] != (4, 4) or not bool(torch.isfinite(poses).all()):
            raise CheckpointError(f"{path}: its path {name!r}, {list(poses.shape)}, is no list of finite poses")
    return paths


def add_paths(paths: dict[str, Tensor], others: Mapping[str, Tensor]) -> None:
    """Add paths to ``paths``; one whose name is taken by another path gets a number, as in ``house-3 (2)``."""
    for name, poses in others.items():
        names = itertools.chain([name], (f"{name} ({number})" for number in itertools.count(2)))
        free = next(name for name in names if name not in paths or torch.equal(paths[name], poses))
        paths[free] = poses
