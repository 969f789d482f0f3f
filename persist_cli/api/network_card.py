"""The card of a trained network that stands alone, as a policy's or that of a model of scenes: JSON beside its weights.

A run's folder stands for its newest checkpoint.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from persist_cli.api.checkpoint import step_folders
from persist_cli.api.training_scenes import TrainingScenes
from persist_cli.errors import CheckpointError
from persist_cli.io.files import file_sha256, read_json, write_json
from persist_cli.io.sha256sums import check_sums

VERSION: Final = 1


@dataclass(frozen=True)
class CardKind:
    """What tells the cards of one kind of network from others.

    Args:
        file: name of the card's file.
        format: value of its key ``format``.
        plugin: its key for the name of the plugin.
        network: the network in words.
        train: the command that trains one.
    """

    file: str
    format: str
    plugin: str
    network: str
    train: str


@dataclass(frozen=True)
class NetworkCard:
    """What a card says of the network beside it.

    Args:
        folder: the folder of card and weights.
        plugin: name of the plugin.
        settings: plain settings of the network.
        fingerprint: a hash of its weights.
        training_scenes: the scenes that it was trained on; ``None`` where that is not known.
        values: all values of the card.
    """

    folder: Path
    plugin: str
    settings: dict[str, Any]
    fingerprint: str
    training_scenes: TrainingScenes | None
    values: Mapping[str, Any]


def write_card(
    kind: CardKind,
    folder: Path,
    plugin: str,
    settings: dict[str, Any],
    scenes: TrainingScenes | None,
    more: Mapping[str, Any] | None = None,
) -> None:
    """Write the card of a network whose weights are in a folder.

    Args:
        kind: the kind of the network.
        folder: a folder with its safetensors files.
        plugin: name of the plugin.
        settings: plain settings of the network.
        scenes: the scenes that it was trained on, where they are known.
        more: further values of the card.
    """
    hashes = "".join(file_sha256(path) for path in sorted(folder.glob("*.safetensors")))
    fingerprint = hashlib.sha256(hashes.encode()).hexdigest()
    card: dict[str, Any] = {"format": kind.format, "version": VERSION, kind.plugin: plugin, "fingerprint": fingerprint}
    lineage = {} if scenes is None else {"training_scenes": scenes.to_json()}
    write_json(folder / kind.file, {**card, **(more or {}), "settings": settings, **lineage})


def find_card(kind: CardKind, path: Path) -> NetworkCard:
    """Return the card in a folder, or that of a run's newest checkpoint.

    Raises:
        CheckpointError: when there is none, or it is damaged.
    """
    folder = card_folder(kind, path)
    if folder is None:
        raise CheckpointError(f"{path}: no {kind.network} there (no {kind.file}); train one: {kind.train}")
    check_sums(folder, lambda name: name == kind.file)  # the weights are verified when they are loaded
    card = read_json(folder / kind.file)
    if not isinstance(card, dict) or card.get("format") != kind.format or card.get("version") != VERSION:
        raise CheckpointError(f"{folder / kind.file}: not the card of a {kind.network} of version {VERSION}")
    scenes = card.get("training_scenes")
    try:
        return NetworkCard(
            folder, str(card[kind.plugin]), dict(card["settings"]), str(card["fingerprint"]),
            None if scenes is None else TrainingScenes.from_json(scenes), card,
        )  # fmt: skip
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{folder / kind.file}: the card is damaged ({error})") from error


def card_folder(kind: CardKind, path: Path) -> Path | None:
    """Return the folder of the card of a folder, a checkpoint or a run; ``None`` where there is none."""
    steps = step_folders(path)
    places = (path, path / "model", *([steps[-1] / "model"] if steps else []))
    return next((place for place in places if (place / kind.file).is_file()), None)
