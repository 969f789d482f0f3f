"""The folder of a weight: its tensors, its configuration, and a card that says where they came from."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from persist_cli import __version__
from persist_cli.weights.archives import check_file, unpack_original
from persist_cli.weights.catalog import Weight
from persist_cli.weights.conversion import CONFIGS, CONVERSIONS
from persist_cli.weights.directory import Found
from persist_cli.world.errors import CheckpointError
from persist_cli.world.files import file_sha256, read_tensors, write_json, write_tensors

MODEL = "model.safetensors"


@dataclass(frozen=True)
class Taken:
    """What a folder was filled from: in words, its SHA-256, and what of it was verified."""

    source: str
    sha256: str
    check: str


def fill_folder(weight: Weight, found: Found, folder: Path) -> str:
    """Write a weight's files into an empty folder, and say in words what was taken and verified.

    Raises:
        CheckpointError: one line when what was found is damaged or is not this weight.
    """
    if found.form != "converted":
        taken = _convert(weight, found, folder)
    elif weight.digest is None:
        taken = _copy(weight, found, folder)
    else:
        taken = _copy_converted(weight, found, folder)
    if weight.name in CONFIGS:
        write_json(folder / "config.json", CONFIGS[weight.name])
    known = {"name": weight.name, "title": weight.title, "licence": weight.licence}
    came = {"source": taken.source, "source_sha256": taken.sha256, "check": taken.check}
    write_json(folder / "weight.json", known | came | {"sha256": file_sha256(folder / MODEL), "persist": __version__})
    return f"{taken.source}, sha256 {taken.sha256[:12]} {taken.check}"


def tensors_digest(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 over names, types, shapes and numbers: the same however a file orders or pads them."""
    digest = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tensor.dtype} {list(tensor.shape)}\n".encode())
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()


def _convert(weight: Weight, found: Found, folder: Path) -> Taken:
    original = found.path
    if found.form == "archive":
        original = folder / "original"
        unpack_original(weight, found.path, original)
    sha256 = check_file(weight, original)
    write_tensors(folder / MODEL, CONVERSIONS[weight.name](original), {"format": "pt"})
    name = Path(weight.archive.member).name if weight.archive else original.name
    if found.form == "archive":
        original.unlink()
    return Taken(f"{name} of {found.origin}", sha256, "verified")


def _copy(weight: Weight, found: Found, folder: Path) -> Taken:
    sha256 = check_file(weight, found.path)
    read_tensors(found.path)  # whole, and safetensors
    shutil.copyfile(found.path, folder / MODEL)
    if found.config is not None:
        shutil.copyfile(found.config, folder / "config.json")
    elif weight.hub is not None:
        raise CheckpointError(f"{found.path}: refused, config.json is not beside it")
    return Taken(
        f"{found.path.name} of {found.origin}", sha256, "verified" if weight.sha256 else "as it was, not known"
    )


def _copy_converted(weight: Weight, found: Found, folder: Path) -> Taken:
    tensors, _ = read_tensors(found.path)
    if tensors_digest(tensors) != weight.digest:
        raise CheckpointError(f"{found.path}: refused, its tensors are not those of {weight.name}")
    write_tensors(folder / MODEL, tensors, {"format": "pt"})
    return Taken(f"{found.path.name} of {found.origin}", file_sha256(found.path), "tensors verified")
