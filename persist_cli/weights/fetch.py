"""``persist weights``: fetch weights into the cache, list them, and name their folders."""

from __future__ import annotations

import dataclasses
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from persist_cli.errors import CheckpointError, PersistError
from persist_cli.io.files import file_sha256, folder_aside, read_json
from persist_cli.io.hub import cached_weight, weights_home
from persist_cli.output.console import busy, print_json, print_table, say
from persist_cli.weights.catalog import WEIGHTS, Weight, find_weight
from persist_cli.weights.weight_sources import DAY, find_source, from_directory, remove_downloads

SHA256: Final = re.compile("[0-9a-fA-F]{64}")
COLUMNS = ("name", "for", "licence", "MB", "from", "here")


def run_fetch(names: Sequence[str], directory: Path | None, offline: bool, sha256: str | None = None) -> None:
    """Bring weights into the cache, silently those that are there; one that fails does not stop the others.

    An interrupted fetch leaves every weight that was done, every archive that was downloaded whole, and the parts of
    files that the hub's client stores. An archive that pip was in the middle of is downloaded from its beginning.

    Args:
        names: names of weights.
        directory: directory to look into first; else that of the environment variable ``PERSIST_WEIGHTS``.
        offline: never use the network.
        sha256: SHA-256 of the original file of the one weight that is named, whose hash persist does not know.

    Raises:
        PersistError: one line that says for each missing weight which sources failed and why, and what to do.
    """
    weights = [find_weight(name) for name in dict.fromkeys(names)]
    if sha256 is not None:
        weights = [with_hash(weights, sha256)]
    directory = from_directory(directory)
    if directory is not None and not directory.is_dir():
        raise PersistError(f"{directory}: no such directory of weights")
    failures = []
    for weight in weights:
        try:
            fetch_weight(weight, directory, offline)
        except PersistError as error:
            failures.append(str(error))
    if failures:
        raise PersistError("; ".join(failures))
    remove_downloads(weights)


def with_hash(weights: Sequence[Weight], sha256: str) -> Weight:
    """The only one of the weights with the SHA-256 that the user gives for its original file.

    Raises:
        PersistError: when it is no SHA-256, several weights are named, or persist knows the hash itself.
    """
    if not SHA256.fullmatch(sha256):
        raise PersistError(f"--sha256 {sha256}: a SHA-256 has 64 digits of 0-9 and a-f, as sha256sum prints it")
    if len(weights) != 1 or not weights[0].original:
        unknown = ", ".join(weight.name for weight in WEIGHTS.values() if weight.original)
        raise PersistError(f"--sha256 is for one weight whose hash is not known here ({unknown}); name that alone")
    return dataclasses.replace(weights[0], sha256=sha256.lower())


def fetch_weight(weight: Weight, directory: Path | None, offline: bool) -> None:
    """Bring one weight into the cache, whole or not at all, and print on one line where it came from.

    Nothing happens when the cache has it whole.

    Raises:
        PersistError: one line when no source has it, its file is refused, or the cached one was made from a file with
            another hash than the user gives.
    """
    from persist_cli.weights.cache import fill_folder  # with torch, which lists and paths do not need

    if is_whole(weight.name):
        if weight.original and weight.sha256 is not None:
            _check_cached(weight, weight.sha256)
        return
    if weight.original and weight.sha256 is None:
        raise PersistError(
            f"weights {weight.name}: refused without a hash; that of {weight.original} is not known here, so give "
            "the one that you trust: --sha256 HASH"
        )
    home = weights_home()
    try:
        home.mkdir(parents=True, exist_ok=True)
        file = find_source(weight, directory, offline)
        verifying = busy(f"{weight.name}: verifying and converting")
        with folder_aside(home / weight.name, DAY) as aside, verifying:
            provenance = fill_folder(weight, file, aside)
    except CheckpointError:
        remove_downloads([weight])  # or the same archive would be refused for ever
        raise
    except OSError as error:
        raise PersistError(f"{home}: {weight.name} cannot be written there ({error})") from error
    say(f"{weight.name}: {provenance} -> {home / weight.name}")


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


def _check_cached(weight: Weight, sha256: str) -> None:
    """Raise ``CheckpointError`` unless the cached weight was made from the file with the hash that the user gives."""
    folder = weights_home() / weight.name
    source = read_json(folder / "weight.json").get("source_sha256")
    if source != sha256:
        raise CheckpointError(
            f"{folder}: refused, it was made from a file whose SHA-256 is {source}, not {sha256}; delete the folder to "
            "fetch another"
        )


def show_weights(json: bool) -> None:
    """Print every weight that the tool may need as a table, or with hashes as JSON."""
    if json:
        print_json([_record(weight) for weight in WEIGHTS.values()])
    else:
        print_table("Weights", COLUMNS, [_row(weight) for weight in WEIGHTS.values()])


def show_path(name: str) -> None:
    """Print the folder of a fetched weight, and nothing else.

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
