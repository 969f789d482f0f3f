"""``persist weights fetch``: the first source that has a weight, verified, converted once, whole or not at all."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

from persist_cli.errors import CheckpointError, PersistError
from persist_cli.io.files import file_sha256, folder_aside, read_json
from persist_cli.io.hub import cached_weight, weights_home
from persist_cli.viewing.console import PROGRESS, print_json, print_table, say
from persist_cli.weights.cache import fill_folder
from persist_cli.weights.catalog import WEIGHTS, Weight, find_weight
from persist_cli.weights.sources import (
    Found,
    SourceError,
    download_archive,
    find_in_directory,
    given_directory,
    hub_files,
)

DOWNLOADS = ".downloads"


def run_fetch(names: Sequence[str], directory: Path | None, offline: bool) -> None:
    """Bring weights into the cache, silently those that are there; one that fails does not stop the others.

    What is kept of an interrupted fetch: every weight that was done, every archive that was downloaded whole, and what
    the hub's client has of a file. An archive that pip was in the middle of is begun again.

    Raises:
        PersistError: one line that says for each weight not had which sources failed and why, and what to do.
    """
    weights = [find_weight(name) for name in dict.fromkeys(names)]
    given = given_directory(directory)
    if given is not None and not given.is_dir():
        raise PersistError(f"{given}: no such directory of weights")
    failures = []
    for weight in weights:
        try:
            fetch_weight(weight, given, offline)
        except PersistError as error:
            failures.append(str(error))
    if failures:
        raise PersistError("; ".join(failures))
    shutil.rmtree(weights_home() / DOWNLOADS, ignore_errors=True)


def fetch_weight(weight: Weight, directory: Path | None, offline: bool) -> None:
    """Bring one weight into the cache unless it is there whole, and say on one line what was taken from where."""
    if is_whole(weight.name):
        return
    home = weights_home()
    try:
        home.mkdir(parents=True, exist_ok=True)
        taken = _keep(weight, find_source(weight, directory, offline), home)
    except CheckpointError:
        shutil.rmtree(home / DOWNLOADS, ignore_errors=True)  # or the same archive would be refused for ever
        raise
    except OSError as error:
        raise PersistError(f"{home}: {weight.name} cannot be written there ({error})") from error
    say(f"{weight.name}: {taken} -> {home / weight.name}")


def _keep(weight: Weight, found: Found, home: Path) -> str:
    """Make the weight's folder aside and then put it in its place; what was taken, in words."""
    verifying = PROGRESS.status(f"{weight.name}: verifying and converting")
    with folder_aside(home / weight.name) as aside, verifying:
        return fill_folder(weight, found, aside)


def is_whole(name: str) -> bool:
    """Whether the cache has the weight, with the SHA-256 that it was written with."""
    folder = cached_weight(name)
    if folder is None or not (folder / "model.safetensors").is_file():
        return False
    try:
        card = read_json(folder / "weight.json")
    except CheckpointError:
        return False
    return isinstance(card, dict) and card.get("sha256") == file_sha256(folder / "model.safetensors")


def find_source(weight: Weight, directory: Path | None, offline: bool) -> Found:
    """The first source that has the weight: directory, hub, package index.

    Raises:
        PersistError: one line with every source, why it does not have it, and what to do.
    """
    tried = []
    if directory is not None:
        found = find_in_directory(weight, directory)
        if found:
            return found
        tried.append(f"directory {directory}: not there")
    try:
        if weight.hub:
            files = hub_files(weight.hub, offline)
            origin = f"hub {weight.hub.name} at {weight.hub.revision[:8]}"
            return Found(files["model.safetensors"], "converted", origin, files["config.json"])
    except SourceError as error:
        tried.append(str(error))
    try:
        if weight.archive:
            return _downloaded(weight, offline)
    except SourceError as error:
        tried.append(str(error))
    raise PersistError(f"weights {weight.name}: {' | '.join(tried) or 'no source of its own'}; {weight.otherwise}")


def _downloaded(weight: Weight, offline: bool) -> Found:
    archive = weight.archive
    assert archive is not None
    folder = weights_home() / DOWNLOADS
    if offline and not (folder / archive.file).is_file():
        raise SourceError(f"{archive.project} {archive.version} of the package index: not asked")
    path = download_archive(archive, folder, weight.size or 0)
    return Found(path, "archive", f"{archive.project} {archive.version} of the package index")


COLUMNS = ("name", "for", "licence", "MB", "from", "here")


def show_weights(json: bool) -> None:
    """A table of every weight the tool may need, or the same with hashes as JSON."""
    if json:
        print_json([_record(weight) for weight in WEIGHTS.values()])
    else:
        print_table("Weights", COLUMNS, [_row(weight) for weight in WEIGHTS.values()])


def show_path(name: str) -> None:
    """The folder of a fetched weight on standard output, and nothing else.

    Raises:
        PersistError: when it was not fetched.
    """
    folder = cached_weight(find_weight(name).name)
    if folder is None:
        raise PersistError(f"weights {name} are not here: persist weights fetch {name}")
    sys.stdout.write(f"{folder}\n")


def _row(weight: Weight) -> list[str]:
    size = "?" if weight.size is None else f"{weight.size / 1e6:.1f}"
    here = "yes" if cached_weight(weight.name) else "no"
    return [weight.name, weight.use, weight.licence, size, ", ".join(weight.sources()), here]


def _record(weight: Weight) -> dict[str, object]:
    folder = cached_weight(weight.name)
    return {
        "name": weight.name,
        "title": weight.title,
        "use": weight.use,
        "licence": weight.licence,
        "bytes": weight.size,
        "sha256": weight.sha256,
        "sources": weight.sources(),
        "path": str(folder) if folder else None,
    }
