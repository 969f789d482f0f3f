"""Memory files: safetensors files whose header names the memory, its encoder and their settings."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from persist_cli.api.memory import FORMAT_VERSION, PATH, FrameOfReference, Memory
from persist_cli.errors import CheckpointError, PersistError
from persist_cli.io.files import read_tensors
from persist_cli.memorize.imagining import with_scene_model
from persist_cli.plugins import make_encoder, make_memory

FORMAT = "persist-memory"
FIELDS: dict[str, type | tuple[type, ...]] = {
    "memory": str,
    "settings": dict,
    "encoder": str,
    "encoder_settings": dict,
    "channels": int,
    "reference": str,
    "world_up": list,
    "cells": int,
}


def read_header(path: Path) -> dict[str, Any]:
    """Return the header of a memory file, as ``Memory.header`` made it, without reading its tensors.

    Raises:
        CheckpointError: when the file is missing, truncated, no memory, of a newer version, or its header is damaged.
    """
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise CheckpointError(f"{path}: no such memory file; `persist memorize` writes one")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
    except (SafetensorError, ValueError, OSError) as error:
        raise CheckpointError(f"{path}: not a whole memory file ({str(error).splitlines()[0]})") from error
    return _checked_header(metadata, path)


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
    if memory.figures().cells != header["cells"]:
        raise CheckpointError(f"{path}: holds {memory.figures().cells} cells, its header says {header['cells']}")
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


def _checked_header(metadata: dict[str, str], path: Path) -> dict[str, Any]:
    if "persist" not in metadata:
        raise CheckpointError(f"{path}: a safetensors file, but no memory of persist (it has no 'persist' header)")
    try:
        header = json.loads(metadata["persist"])
    except ValueError as error:
        raise CheckpointError(f"{path}: its header is damaged ({error})") from error
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise CheckpointError(f"{path}: written by persist, but not as a memory file")
    version = header.get("version")
    if not isinstance(version, int) or version > FORMAT_VERSION:
        raise CheckpointError(f"{path}: of version {version}; this persist reads versions up to {FORMAT_VERSION}")
    wrong = [name for name, kind in FIELDS.items() if not isinstance(header.get(name), kind)]
    if not wrong and not _is_direction(header["world_up"]):
        wrong = ["world_up"]
    if wrong:
        raise CheckpointError(f"{path}: its header is damaged (see {', '.join(wrong)})")
    return header


def _is_direction(values: list[Any]) -> bool:
    return len(values) == 3 and all(isinstance(value, int | float) for value in values) and any(values)
