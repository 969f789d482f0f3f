"""``persist weights list`` and ``persist weights path``."""

from __future__ import annotations

import sys

from persist_cli.viewing.console import print_json, print_table
from persist_cli.weights.catalog import WEIGHTS, Weight, find_weight
from persist_cli.world.errors import PersistError
from persist_cli.world.weights import cached_weight

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
