"""Files damaged at random places: a bit flipped, bytes zeroed, or the end cut off; and an image too large to read."""

from __future__ import annotations

import random
import shutil
import struct
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path

ZEROED = 16  # bytes


def damaged(file: Path, kind: str, draw: random.Random) -> bytes:
    """The bytes of a file with one damage; they always differ from those of the file."""
    while True:
        content = bytearray(file.read_bytes())
        place = draw.randrange(len(content))
        if kind == "flip":
            content[place] ^= 1 << draw.randrange(8)
        elif kind == "zero":
            content[place : place + ZEROED] = bytes(len(content[place : place + ZEROED]))
        else:
            del content[place:]
        if bytes(content) != file.read_bytes():
            return bytes(content)


def damages(paths: Sequence[Path], count: int, seed: int = 0) -> Iterator[str]:
    """Damage one of the files at a time, chosen at random, and mend it again; yields what was done to which."""
    draw = random.Random(seed)
    for number in range(count):
        file, kind = draw.choice(paths), ("flip", "zero", "truncate")[number % 3]
        whole, content = file.read_bytes(), damaged(file, kind, draw)
        file.write_bytes(content)
        try:
            yield f"{number}: {kind} {file.name}"
        finally:
            file.write_bytes(whole)


def files_below(*folders: Path) -> list[Path]:
    """All files in folders and below, sorted."""
    return sorted(path for folder in folders for path in folder.rglob("*") if path.is_file())


def without_sums(folder: Path) -> Path:
    """Delete the list of checksums of a checkpoint, whose files a test is about to change; returns the folder."""
    (folder / "SHA256SUMS").unlink()
    return folder


def copied(folder: Path, target: Path) -> Path:
    """A copy of a folder, whose files a test may damage."""
    shutil.copytree(folder, target)
    return target


def write_huge_image(path: Path) -> None:
    """Write the beginning of a PNG of 30,000 × 30,000 pixels, which Pillow refuses to decode."""
    header = b"IHDR" + struct.pack(">IIBBBBB", 30_000, 30_000, 8, 2, 0, 0, 0)
    chunk = struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk + struct.pack(">I", 8) + b"IDAT" + bytes(12))
