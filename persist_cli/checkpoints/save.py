"""Checkpoints written: bases, LoRA and adapters, each with the card that makes its folder a checkpoint."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from persist_cli.api.checkpoint import CARD, VERSION, Checkpoint, TrainingScenes, run_folder
from persist_cli.io.files import write_json
from persist_cli.io.sha256sums import hash_files, write_sums
from persist_cli.recipe import MemoryConfig

if TYPE_CHECKING:
    from persist_cli.api.backbone import Backbone


def save_base(backbone: Backbone, folder: Path, scenes: TrainingScenes | None = None) -> None:
    """Write the backbone's own files, a card and ``SHA256SUMS``.

    The existing folder may hold other files, which are listed too.
    """
    backbone.save_base(folder)
    hashes = hash_weights(folder)
    card = {"backbone": backbone.name, "settings": backbone.checkpoint_settings(), "fingerprint": fingerprint(hashes)}
    write_card(folder, card, scenes)
    write_sums(folder, hashes)


def save_lora(
    backbone: Backbone, base: Checkpoint | None, folder: Path, home: Path, scenes: TrainingScenes | None = None
) -> None:
    """Write what LoRA trained, a card that points to the base that it changes, and ``SHA256SUMS``.

    Args:
        backbone: a backbone with LoRA.
        base: the checkpoint that LoRA was trained on; ``None`` for the pretrained weights in the backbone's settings.
        folder: the existing folder to write into, which may hold other files to be listed.
        home: the place where that folder will be in the end; the path to the base is relative to it.
        scenes: the scenes that base and LoRA were trained on, where they are known.
    """
    backbone.save_lora(folder)
    changes: dict[str, Any] = {"settings": backbone.origin()}
    if base is not None:
        changes = {"base": _path_to_base(base, home), "fingerprint": base.fingerprint}
    hashes = hash_weights(folder)
    own = hashlib.sha256(f"{fingerprint(hashes)} {changes.get('fingerprint')}".encode()).hexdigest()
    card = {"backbone": backbone.name, "settings": backbone.checkpoint_settings()}
    write_card(folder, card | {"changes": changes, "fingerprint": own}, scenes)
    write_sums(folder, hashes)


def write_card(folder: Path, card: dict[str, Any], scenes: TrainingScenes | None) -> None:
    """Write ``persist.json``, the card that makes a folder a checkpoint."""
    lineage = {} if scenes is None else {"training_scenes": scenes.to_json()}
    write_json(folder / CARD, {"format": "persist-checkpoint", "version": VERSION} | card | lineage)


def save_adapter(
    backbone: Backbone,
    base: Checkpoint,
    memory: MemoryConfig,
    folder: Path,
    home: Path,
    scenes: TrainingScenes | None = None,
) -> None:
    """Write the adapter in use, a card that points to its base, and ``SHA256SUMS``.

    Args:
        backbone: a backbone that uses the adapter.
        base: the checkpoint that the adapter was trained on.
        memory: the choice of the memory that the adapter reads.
        folder: the existing folder to write into, which may hold other files to be listed.
        home: the place where that folder will be in the end; the path to the base is relative to it.
        scenes: the scenes that base and adapter were trained on, where they are known.
    """
    adapter = folder / "adapters" / memory.name
    adapter.mkdir(parents=True)
    backbone.save_adapter(adapter)
    write_json(adapter / "memory.json", dataclasses.asdict(memory))
    write_card(folder, {"base": _path_to_base(base, home), "fingerprint": base.fingerprint}, scenes)
    write_sums(folder)


def base_files(folder: Path, pattern: str) -> list[Path]:
    """The files under a checkpoint's folder that match a pattern, without those of adapters, sorted by path."""
    files = (path for path in folder.rglob(pattern) if path.is_file())
    return sorted(path for path in files if path.relative_to(folder).parts[0] != "adapters")


def hash_weights(folder: Path) -> dict[str, str]:
    """SHA-256 of each weight file of a checkpoint's base by its name in the folder."""
    return hash_files(folder, [path.relative_to(folder).as_posix() for path in base_files(folder, "*.safetensors")])


def fingerprint(hashes: Mapping[str, str]) -> str:
    """SHA-256 over all weight files of a checkpoint's base, in order of their paths, given those of the files."""
    digest = hashlib.sha256()
    for path in sorted(map(Path, hashes)):
        digest.update(str(path).encode())
        digest.update(bytes.fromhex(hashes[path.as_posix()]))
    return digest.hexdigest()


def _path_to_base(base: Checkpoint, home: Path) -> str:
    return os.path.relpath(run_folder(base.base_folder).resolve(), home.resolve())
