"""Files that are whole or absent: written aside, synced and renamed; safetensors read with one-line errors."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import re
import shutil
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from persist_cli.errors import CheckpointError, PersistError

if TYPE_CHECKING:
    from torch import Tensor, nn


ASIDE = ".partial-"


def check_folder(path: Path) -> None:
    """Raise ``PersistError`` when a file stands where this folder is or would be made, before any work is done."""
    there = next((each for each in (path, *path.parents) if each.exists()), path)
    if there.exists() and not there.is_dir():
        raise PersistError(f"{path}: no folder can be made there, {there} is a file; choose another --out")


@contextlib.contextmanager
def written_aside(path: Path) -> Iterator[Path]:
    """A temporary path in the same folder that becomes ``path`` when the block ends well."""
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = _place_aside(path)
    try:
        yield aside
        with aside.open("rb") as file:
            os.fsync(file.fileno())
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write text, whole or not at all."""
    with written_aside(path) as aside:
        aside.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write JSON, whole or not at all; NaN and infinity become null."""
    write_text(path, json.dumps(plain(value), indent=2, allow_nan=False) + "\n")


def plain(value: Any) -> Any:
    """JSON values without NaN and infinity, which JSON does not have: they become null."""
    if isinstance(value, Mapping):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None) -> None:
    """Write a safetensors file, whole or not at all.

    Raises:
        OSError: when it cannot be written, as on a full disk.
    """
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    # safetensors writes a nameless temporary file beside its target: a folder around both can be found after a kill
    with empty_folder_aside(path) as around:
        with written_aside(around / path.name) as aside:
            try:
                save_file(contiguous, aside, dict(metadata or {}))
            except SafetensorError as error:
                raise _of_the_system(path, str(error).splitlines()[0]) from error
        (around / path.name).replace(path)


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and metadata of a safetensors file, the tensors in memory that torch allocated.

    Those that safetensors gives lie where they lie in the file. At addresses that are not aligned as torch's own are,
    some processors' kernels round differently, so a model that was read would not compute what the written one did.

    Raises:
        CheckpointError: one line when the file is missing, truncated or not safetensors.
    """
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise CheckpointError(f"{path}: no such file")
    try:
        with safe_open(path, framework="pt") as file:
            return {name: file.get_tensor(name).clone() for name in file.keys()}, dict(file.metadata() or {})  # noqa: SIM118
    except (SafetensorError, ValueError, OSError) as error:
        raise CheckpointError(f"{path}: not a whole safetensors file ({str(error).splitlines()[0]})") from error


def reallocate(module: nn.Module) -> None:
    """Move the weights of a module that another library read into memory that torch allocated; see ``read_tensors``."""
    for tensor in (*module.parameters(), *module.buffers()):
        tensor.data = tensor.data.clone()


def read_json(path: Path) -> Any:
    """The value of a JSON file.

    Raises:
        CheckpointError: one line when the file is missing or not JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise CheckpointError(f"{path}: no such file") from error
    except (ValueError, OSError) as error:
        raise CheckpointError(f"{path}: not readable as JSON ({error})") from error


def file_sha256(path: Path) -> str:
    """SHA-256 of a file in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@contextlib.contextmanager
def empty_folder_aside(path: Path) -> Iterator[Path]:
    """A temporary folder beside ``path``; what is still in it when the block ends is removed with it."""
    aside = _place_aside(path)
    aside.mkdir(parents=True)
    try:
        yield aside
    finally:
        shutil.rmtree(aside, ignore_errors=True)


@contextlib.contextmanager
def folder_aside(path: Path) -> Iterator[Path]:
    """A temporary folder that becomes ``path`` when the block ends well, in the place of what is there by then.

    What a killed writer of ``path`` left aside is removed first.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_leftovers(path.parent, path.name)
    with empty_folder_aside(path) as aside:
        yield aside
        if path.exists():  # no folder can be renamed over one that holds something: the old one steps aside first
            with empty_folder_aside(path) as old:
                path.rename(old / path.name)
                aside.rename(path)
        else:
            aside.rename(path)


def remove_leftovers(folder: Path, name: str = "") -> None:
    """Delete what a killed writer left aside in ``folder``, of all files or of those of one ``name``."""
    for leftover in folder.glob(f"{ASIDE}*"):
        owner = leftover.name.removeprefix(ASIDE).partition("-")[2]
        if name and owner != name:
            continue
        if leftover.is_dir():
            shutil.rmtree(leftover, ignore_errors=True)
        else:
            leftover.unlink(missing_ok=True)


def _of_the_system(path: Path, said: str) -> OSError:
    """The system's error that another language reports as text."""
    found = re.search(r"os error (\d+)", said)
    return OSError(int(found[1]), os.strerror(int(found[1])), str(path)) if found else OSError(f"{path}: {said}")


def _place_aside(path: Path) -> Path:
    return path.parent / f"{ASIDE}{uuid.uuid4().hex[:8]}-{path.name}"


def load_exactly(module: nn.Module, tensors: dict[str, Tensor], names: set[str], path: Path) -> None:
    """Load tensors under exactly these names and shapes, or raise a one-line ``CheckpointError``.

    The module keeps its precision, whatever the file's.
    """
    state = module.state_dict()
    different = sorted(names ^ set(tensors))
    different += sorted(name for name in names & set(tensors) if state[name].shape != tensors[name].shape)
    if different:
        raise CheckpointError(
            f"{path}: does not fit this model; {len(different)} tensors differ, first {different[0]!r}"
        )
    import torch

    cast = {name: value.to(state[name].dtype) for name, value in tensors.items()}
    with torch.no_grad():
        module.load_state_dict(cast, strict=False, assign=any(state[name].is_meta for name in names))
