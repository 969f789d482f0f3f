"""Folders of checkpoints: where a run keeps them, their cards, their bases and their adapters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from persist_cli.errors import CheckpointError
from persist_cli.io.files import read_json

CARD: Final = "persist.json"

VERSION: Final = 1

STEP: Final = "step-"  # what the folders of a run's checkpoints begin with

PLAIN: Final = "stage1"  # what the base without any adapter is called


@dataclass(frozen=True)
class CheckpointFolder:
    """A checkpoint's folder and that of its base, the same for a base.

    Args:
        folder: of ``persist.json``.
        card: what that says.
        base: folder of the backbone's own files.
        base_card: what its ``persist.json`` says.
    """

    folder: Path
    card: Mapping[str, Any]
    base: Path
    base_card: Mapping[str, Any]

    @property
    def adapters(self) -> dict[str, Path]:
        """Folders of the memory adapters by name."""
        return {each.name: each for each in sorted((self.folder / "adapters").glob("*")) if each.is_dir()}


def open_checkpoint(path: Path) -> CheckpointFolder:
    """The checkpoint in a folder, or the newest of a run.

    Raises:
        CheckpointError: when there is none, its card is damaged, or its base is gone or another.
    """
    folder = model_folder(path)
    base, card = folder, read_card(folder)
    base_card = card
    if card.get("base"):
        base, base_card = _open_base(folder, card)
    return CheckpointFolder(folder, card, base, base_card)


def lora_base(folder: Path) -> Path | dict[str, Any] | None:
    """What the LoRA in a base's folder changes, ``None`` for a base that is whole.

    Returns:
        The folder of another base, or those settings of the backbone that bring pretrained weights.

    Raises:
        CheckpointError: when that base is gone or another.
    """
    changes = read_card(folder).get("changes") if (folder / CARD).is_file() else None
    if changes is None:
        return None
    if "settings" in changes:
        return dict(changes["settings"])
    return _open_base(folder, changes)[0]


def _open_base(folder: Path, pointer: Mapping[str, Any]) -> tuple[Path, dict[str, Any]]:
    """The folder and the card of the base that a checkpoint points to, if it is still the one it was trained on."""
    base = model_folder((folder / pointer["base"]).resolve())
    card = read_card(base)
    if card["fingerprint"] != str(pointer.get("fingerprint", "")):
        raise CheckpointError(f"{folder}: was trained on another base than the one now at {base}")
    return base, card


def step_folders(run: Path) -> list[Path]:
    """Whole checkpoints of a run, the newest last."""
    return sorted(folder for folder in run.glob(f"{STEP}*") if folder.is_dir())


def model_folder(path: Path) -> Path:
    """The folder itself, or that of the newest checkpoint of a run."""
    if (path / CARD).is_file():
        return path
    steps = step_folders(path)
    if not steps:
        raise CheckpointError(f"{path}: no checkpoint there (neither persist.json nor a finetune run's step-* folder)")
    return steps[-1] / "model"


def read_card(folder: Path) -> dict[str, Any]:
    """A checkpoint's card, whole and of the version that this ``persist`` reads."""
    path = folder / CARD
    card = read_json(path)
    if not isinstance(card, dict) or card.get("format") != "persist-checkpoint":
        raise CheckpointError(f"{path}: not the card of a persist checkpoint")
    if card.get("version") != VERSION:
        raise CheckpointError(f"{path}: checkpoint version {card.get('version')}, this persist reads {VERSION}")
    if not card.get("fingerprint") or not (card.get("base") or {"backbone", "settings"} <= set(card)):
        raise CheckpointError(f"{path}: the card is incomplete")
    return card


def default_adapter(folder: Path, adapters: Mapping[str, Path], default: str | None) -> str | None:
    """The default or the only adapter, or none when there is none; an error when one must be chosen."""
    if default in adapters:
        return default
    if len(adapters) > 1:
        raise CheckpointError(f"{folder}: choose an adapter of {', '.join(adapters)} with --adapter")
    return next(iter(adapters), None)


def adapter_folder(folder: Path, adapters: Mapping[str, Path], name: str) -> Path:
    """The adapter's folder; a one-line error that names the others when there is none."""
    if name not in adapters:
        known = ", ".join(adapters) or "none"
        raise CheckpointError(f"{folder}: no memory adapter {name!r} in it; it has {known}")
    return adapters[name]
