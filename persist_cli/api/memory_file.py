"""The header of memory files, safetensors files that name the memory, its encoder and their settings."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

from persist_cli.errors import CheckpointError

FORMAT: Final = "persist-memory"
FORMAT_VERSION: Final = 2  # 1 has neither origins nor paths
FIELDS: Final[dict[str, type | tuple[type, ...]]] = {
    "memory": str,
    "settings": dict,
    "encoder": str,
    "encoder_settings": dict,
    "channels": int,
    "reference": str,
    "world_up": list,
    "cells": int,
}
LARGEST: Final = 2**53  # of a number of a direction, which then is finite as float64
LENGTH: Final = 8  # bytes of a safetensors file before its header, which is JSON


def is_memory_file(text: str) -> bool:
    """Whether a word that may also name frames means a memory file, which may be damaged or missing.

    It does by its suffix, or as a file that begins as one of safetensors does.
    """
    path = Path(text)
    if path.suffix == ".safetensors" or not path.is_file():
        return path.suffix == ".safetensors"
    with path.open("rb") as file:
        return file.read(LENGTH + 1)[LENGTH:] == b"{"


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


def _checked_header(metadata: dict[str, str], path: Path) -> dict[str, Any]:
    if "persist" not in metadata:
        raise CheckpointError(f"{path}: a safetensors file, but no memory of persist (it has no 'persist' header)")
    try:
        header = json.loads(metadata["persist"])
    except (ValueError, RecursionError) as error:
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
    numbers = len(values) == 3 and all(type(value) in (int, float) and abs(value) < LARGEST for value in values)
    return numbers and any(values)
