"""Checkpoints: one base and small memory adapters that load onto it by name.

A checkpoint folder holds ``persist.json``, the backbone's own files and ``adapters/NAME/``; that of a stage-2 run
holds adapters only and says where its base is. A run folder stands for its newest checkpoint.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from persist_cli.recipe import MemoryChoice
from persist_cli.world.errors import CheckpointError
from persist_cli.world.files import file_sha256, read_json, write_json
from persist_cli.world.settings import parse_settings

if TYPE_CHECKING:
    from persist_cli.world.backbone import Backbone

CARD = "persist.json"
VERSION = 1


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint that was found, its weights not loaded yet.

    Args:
        folder: of ``persist.json``.
        name: what tables call it, the run's or folder's name.
        base_folder: where the backbone's own files are.
        backbone: name of the plugin.
        settings: for the plugin.
        fingerprint: of the base's weights.
        adapters: folders of the memory adapters by name.
        default: which of several adapters is meant when none is named.
        sampling: ``steps`` and ``sampler`` that are meant when none are named, as far as the card says.
    """

    folder: Path
    name: str
    base_folder: Path
    backbone: str
    settings: dict[str, Any]
    fingerprint: str
    adapters: dict[str, Path]
    default: str | None = None
    sampling: dict[str, Any] = field(default_factory=dict)

    def memory_choice(self, adapter: str) -> MemoryChoice:
        """What the adapter's memory is made of."""
        path = self.adapter_folder(adapter) / "memory.json"
        return parse_settings(MemoryChoice, read_json(path), str(path))

    def adapter_folder(self, adapter: str) -> Path:
        """The adapter's folder; a one-line error that names the others when there is none."""
        if adapter not in self.adapters:
            known = ", ".join(self.adapters) or "none"
            raise CheckpointError(f"{self.folder}: no memory adapter {adapter!r} in it; it has {known}")
        return self.adapters[adapter]

    def default_adapter(self) -> str | None:
        """The card's default or the only adapter, or none when there is none; an error when one must be chosen."""
        if self.default in self.adapters:
            return self.default
        if len(self.adapters) > 1:
            raise CheckpointError(f"{self.folder}: choose an adapter of {', '.join(self.adapters)} with --adapter")
        return next(iter(self.adapters), None)


def step_folders(run: Path) -> list[Path]:
    """Whole checkpoints of a run, the newest last."""
    return sorted(folder for folder in run.glob("step-*") if folder.is_dir())


def find_checkpoint(path: Path) -> Checkpoint:
    """The checkpoint in a folder, or the newest of a run.

    Raises:
        CheckpointError: when there is none, it is damaged, or its base is gone or another.
    """
    folder = _model_folder(path)
    card = _read_card(folder)
    base_folder, fingerprint = folder, str(card.get("fingerprint", ""))
    if card.get("base"):
        base_folder = _model_folder((folder / card["base"]).resolve())
        base_card = _read_card(base_folder)
        if base_card["fingerprint"] != fingerprint:
            raise CheckpointError(f"{folder}: was trained on another base than the one now at {base_folder}")
        card = base_card
    return Checkpoint(
        folder=folder,
        name=folder.parent.parent.name if folder.name == "model" else folder.name,
        base_folder=base_folder,
        backbone=card["backbone"],
        settings=card["settings"],
        fingerprint=fingerprint,
        adapters={each.name: each for each in sorted((folder / "adapters").glob("*")) if each.is_dir()},
        default=card.get("default_adapter"),
        sampling=card.get("sampling", {}),
    )


def load_backbone(checkpoint: Checkpoint, settings: dict[str, Any] | None = None) -> Backbone:
    """The base's backbone without adapters, with changed settings where given."""
    import torch

    from persist_cli.registry import make_backbone

    with torch.device("meta"):  # the weights come from the files
        backbone = make_backbone(checkpoint.backbone, checkpoint.settings | (settings or {}))
    backbone.load_base(checkpoint.base_folder)
    return backbone


def sampling_of(checkpoint: Checkpoint, steps: int | None, sampler: str | None) -> tuple[int, str]:
    """Steps and sampler: those asked for, else the checkpoint's, else 50 steps of DDIM."""
    from persist_cli.world.backbone import Sampling

    own: dict[str, Any] = {"steps": Sampling.steps, "sampler": Sampling.sampler} | checkpoint.sampling
    return steps or int(own["steps"]), sampler or str(own["sampler"])


def load_adapter(backbone: Backbone, checkpoint: Checkpoint, adapter: str | None) -> None:
    """Load an adapter of the checkpoint onto its backbone and use it; ``None`` is plain stage 1."""
    if adapter is None:
        backbone.use_adapter(None)
    else:
        backbone.load_adapter(adapter, checkpoint.adapter_folder(adapter))


def save_base(backbone: Backbone, folder: Path) -> None:
    """Write the backbone's own files and its card into an existing folder."""
    backbone.save_base(folder)
    settings = backbone.checkpoint_settings()
    write_card(folder, {"backbone": backbone.name, "settings": settings, "fingerprint": fingerprint(folder)})


def write_card(folder: Path, card: dict[str, Any]) -> None:
    """Write ``persist.json``, which makes a folder a checkpoint."""
    write_json(folder / CARD, {"format": "persist-checkpoint", "version": VERSION} | card)


def save_adapter(backbone: Backbone, base: Checkpoint, choice: MemoryChoice, folder: Path, home: Path) -> None:
    """Write the adapter in use and a card that points to its base.

    Args:
        backbone: with the adapter in use.
        base: what the adapter was trained on.
        choice: its memory.
        folder: to write into.
        home: where the folder will stand in the end; the way to the base is relative to it.
    """
    adapter = folder / "adapters" / choice.name
    adapter.mkdir(parents=True)
    backbone.save_adapter(adapter)
    write_json(adapter / "memory.json", dataclasses.asdict(choice))
    run = base.base_folder.parent.parent if base.base_folder.name == "model" else base.base_folder
    way = os.path.relpath(run.resolve(), home.resolve())
    write_card(folder, {"base": way, "fingerprint": base.fingerprint})


def base_files(folder: Path, pattern: str) -> list[Path]:
    """Files under a checkpoint folder in order of their names, those of adapters left out."""
    found = (path for path in folder.rglob(pattern) if path.is_file())
    return sorted(path for path in found if path.relative_to(folder).parts[0] != "adapters")


def fingerprint(folder: Path) -> str:
    """SHA-256 over every weight file of a checkpoint's base, in order of their names."""
    digest = hashlib.sha256()
    for path in base_files(folder, "*.safetensors"):
        digest.update(str(path.relative_to(folder)).encode())
        digest.update(bytes.fromhex(file_sha256(path)))
    return digest.hexdigest()


def _model_folder(path: Path) -> Path:
    if (path / CARD).is_file():
        return path
    steps = step_folders(path)
    if not steps:
        raise CheckpointError(f"{path}: no checkpoint there (neither persist.json nor a finetune run's step-* folder)")
    return steps[-1] / "model"


def _read_card(folder: Path) -> dict[str, Any]:
    path = folder / CARD
    card = read_json(path)
    if not isinstance(card, dict) or card.get("format") != "persist-checkpoint":
        raise CheckpointError(f"{path}: not the card of a persist checkpoint")
    if card.get("version") != VERSION:
        raise CheckpointError(f"{path}: checkpoint version {card.get('version')}, this persist reads {VERSION}")
    if not card.get("fingerprint") or not (card.get("base") or {"backbone", "settings"} <= set(card)):
        raise CheckpointError(f"{path}: the card is incomplete")
    if not _is_sampling(card.get("sampling", {})):
        raise CheckpointError(f"{path}: its sampling must hold a number of steps and the name of a sampler")
    return card


def _is_sampling(value: Any) -> bool:
    kinds = {"steps": int, "sampler": str}
    return isinstance(value, dict) and all(isinstance(value[key], kinds[key]) for key in value.keys() & kinds.keys())
