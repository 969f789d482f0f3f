"""``SHA256SUMS``: a list of all files of a folder, which ``sha256sum -c`` reads too."""

from __future__ import annotations

import contextlib
import hashlib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

from persist_cli.errors import CheckpointError
from persist_cli.io.checksums import is_verified
from persist_cli.io.command_line import quoted
from persist_cli.io.files import file_sha256, write_text, written_aside

SUMS: Final = "SHA256SUMS"

LINE: Final = re.compile(r"(?P<sha256>[0-9a-f]{64})  (?P<name>\S.*)")

OURS: Final = (".safetensors", ".json", ".yaml")  # ends of the names of files that must be listed where others are

READERS: Final = 4  # files hashed at once


def hash_files(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """SHA-256 of files by their names in a folder."""
    ordered = sorted(names)
    with ThreadPoolExecutor(READERS) as threads:
        return dict(zip(ordered, threads.map(lambda name: file_sha256(folder / name), ordered), strict=True))


def write_sums(
    folder: Path, known: Mapping[str, str] | None = None, wanted: Callable[[str], bool] = bool
) -> dict[str, str]:
    """Write the list of the files in a folder and below, whole or not at all.

    Args:
        folder: a folder whose files are written.
        known: SHA-256 of files that were hashed already, by their names in the folder.
        wanted: chooses files by their names in the folder; all by default.

    Returns:
        SHA-256 of each file by its name in the folder.
    """
    known = known or {}
    hashes = {**known, **hash_files(folder, (name for name in _names(folder) if wanted(name) and name not in known))}
    write_text(folder / SUMS, _text(hashes))
    return hashes


def rewrite_files(texts: Mapping[Path, Mapping[str, str]]) -> None:
    """Replace text files and their lines in the lists of their folders; all are written aside before any is replaced.

    Args:
        texts: the new texts by folder and by name in it; a folder of an earlier version needs no list.
    """
    with contextlib.ExitStack() as stack:
        for folder, files in texts.items():
            sums, written = read_sums(folder), dict(files)
            if sums is not None:
                written[SUMS] = _text(sums | {name: _sha256(text) for name, text in files.items()})
            for name, text in written.items():
                aside = stack.enter_context(written_aside(folder / name))
                aside.write_text(text, encoding="utf-8", newline="\n")


def read_sums(folder: Path) -> dict[str, str] | None:
    """SHA-256 of each file by its name, as the folder's list says; ``None`` without a list.

    Raises:
        CheckpointError: when the list is damaged.
    """
    path = folder / SUMS
    if not path.is_file():
        return None
    try:
        lines = path.read_text(encoding="utf-8").split("\n")
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path}: cannot be read ({error}); {_ADVICE}") from error
    matches = [LINE.fullmatch(line) for line in lines[:-1]]
    if not matches or lines[-1] or not all(matches):
        raise CheckpointError(f"{path}: damaged, not a list of SHA-256 and names; {_ADVICE}")
    return {match["name"]: match["sha256"] for match in matches if match}


def check_sums(folder: Path, wanted: Callable[[str], bool] = bool) -> None:
    """Verify files of a folder that has a list; large ones only where everything is verified.

    Args:
        folder: the folder; one of an earlier version, which has no list, is taken as it is.
        wanted: chooses files by their names in the folder.

    Raises:
        CheckpointError: one line for the first file that is missing, differs, or should be listed.
    """
    sums = read_sums(folder)
    if sums is None:
        return
    listed = sorted(name for name in sums if wanted(name))
    missing = next((name for name in listed if not (folder / name).is_file()), None)
    if missing is not None:
        raise CheckpointError(f"{folder / missing}: no such file, though {SUMS} lists it; {_ADVICE}")
    unlisted = next((name for name in _unlisted(folder, sums) if wanted(name)), None)
    if unlisted is not None:
        raise CheckpointError(
            f"{folder / unlisted}: not listed in {SUMS} beside it; if you added it: cd {quoted(folder)} && "
            f"sha256sum {quoted(unlisted)} >> {SUMS}"
        )
    hashes = hash_files(folder, (name for name in listed if is_verified(folder / name)))
    for name, sha256 in hashes.items():
        if sha256 != sums[name]:
            raise CheckpointError(f"{folder / name}: damaged or changed, its SHA-256 is not that in {SUMS}; {_ADVICE}")


_ADVICE: Final = f"take a whole copy, or delete {SUMS} if you changed files yourself"


def _text(hashes: Mapping[str, str]) -> str:
    return "".join(f"{hashes[name]}  {name}\n" for name in sorted(hashes))


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _names(folder: Path) -> Iterator[str]:
    """Names of all files in a folder and below, the list itself and hidden files left out."""
    for path in folder.rglob("*"):
        name = path.relative_to(folder)
        if path.is_file() and name.name != SUMS and not any(part.startswith(".") for part in name.parts):
            yield name.as_posix()


def _unlisted(folder: Path, sums: Mapping[str, str]) -> Iterator[str]:
    """Names of files that should be listed; a subfolder with none that is listed was added later as a whole."""
    folders = {name.rpartition("/")[0] for name in sums} | {""}
    for name in sorted(_names(folder)):
        if name not in sums and name.endswith(OURS) and name.rpartition("/")[0] in folders:
            yield name
