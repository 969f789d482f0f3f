"""Checkpoints: one base, and small memory adapters that load onto it by name.

A checkpoint's folder holds the card ``persist.json``, the backbone's own files and ``adapters/NAME/``. That of a
stage-2 run holds adapters only, and its card says where the base is. That of a LoRA run holds the change of low rank,
and its card says what it changes. A run's folder stands for its newest checkpoint.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from persist_cli.checkpoints.sampling_defaults import read_sampling
from persist_cli.data.scenes import TrainingScenes
from persist_cli.errors import CheckpointError, RecipeError
from persist_cli.io.bundled import bundled_folder
from persist_cli.io.checkpoint_folder import CARD, STEP, VERSION, adapter_folder, default_adapter, open_checkpoint
from persist_cli.io.files import file_sha256, read_json, write_json
from persist_cli.io.settings import parse_settings
from persist_cli.recipe import BackboneConfig, MemoryConfig, Recipe

if TYPE_CHECKING:
    from persist_cli.api.backbone import Backbone, Sampling


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint on disk; its weights are not loaded yet.

    Args:
        folder: the folder of ``persist.json``.
        name: the name of the run or folder, which tables show.
        base_folder: the folder of the backbone's own files.
        backbone: the name of the backbone plugin.
        settings: the plain settings of the backbone.
        fingerprint: a hash of the base's weights.
        adapters: folders of the memory adapters by name.
        default: the name of the adapter to use when a command names none.
        sampling: how to sample when a command does not say; ``None`` when the card does not say either.
        training_scenes: the scenes that base and adapters were trained on; ``None`` for cards of earlier versions.
    """

    folder: Path
    name: str
    base_folder: Path
    backbone: str
    settings: dict[str, Any]
    fingerprint: str
    adapters: dict[str, Path]
    default: str | None = None
    sampling: Sampling | None = None
    training_scenes: TrainingScenes | None = None

    def memory_config(self, adapter: str) -> MemoryConfig:
        """The choice of the memory that the adapter reads."""
        path = self.adapter_folder(adapter) / "memory.json"
        return parse_settings(MemoryConfig, read_json(path), str(path))

    def adapter_folder(self, adapter: str) -> Path:
        """The adapter's folder.

        Raises:
            CheckpointError: when there is no such adapter, naming those that there are.
        """
        return adapter_folder(self.folder, self.adapters, adapter)

    def default_adapter(self) -> str | None:
        """The card's default or only adapter, ``None`` when there is no adapter.

        Raises:
            CheckpointError: when there are several adapters and no default.
        """
        return default_adapter(self.folder, self.adapters, self.default)


def find_checkpoint(path: Path) -> Checkpoint:
    """The checkpoint in a folder, or the newest of a run.

    Raises:
        CheckpointError: when there is none, it is damaged, or its base is gone or another.
    """
    found = open_checkpoint(path)
    return Checkpoint(
        folder=found.folder,
        name=_home(found.folder).name,
        base_folder=found.base,
        backbone=found.base_card["backbone"],
        settings=found.base_card["settings"],
        fingerprint=str(found.card.get("fingerprint", "")),
        adapters=found.adapters,
        default=found.base_card.get("default_adapter"),
        sampling=read_sampling(dict(found.card), found.folder / CARD),
        training_scenes=_training_scenes(dict(found.card), found.folder / CARD),
    )


def reference_checkpoint() -> Path:
    """The folder of the reference model that comes with the package, a checkpoint with an adapter for each memory.

    Raises:
        CheckpointError: when this installation does not have it.
    """
    folder = bundled_folder("reference")
    if not (folder / CARD).is_file():
        raise CheckpointError(f"no reference model in {folder}: it comes with the package; give a CHECKPOINT")
    return folder


def load_backbone(checkpoint: Checkpoint, settings: dict[str, Any] | None = None) -> Backbone:
    """The base's backbone without adapters, with changed settings where given; LoRA is merged."""
    backbone = empty_backbone(checkpoint, settings)
    backbone.load_base(checkpoint.base_folder)
    return backbone


def start_backbone(choice: BackboneConfig, base: Checkpoint | None) -> Backbone:
    """The backbone that a training begins with: fresh, or the base's with the choice's settings on top.

    Raises:
        RecipeError: when the base is of another backbone.
    """
    if base is None:
        from persist_cli.plugins import make_backbone

        return make_backbone(choice.name, choice.settings)
    if base.backbone != choice.name:
        raise RecipeError(f"base {base.folder} is of backbone {base.backbone!r}, not {choice.name!r}")
    return load_backbone(base, choice.settings)


def starts_from_random_codec(recipe: Recipe, backbone: Backbone) -> bool:
    """Whether the video model would be trained on the latents of a codec with random weights."""
    return recipe.stage == "1" and recipe.base is None and not backbone.origin()


def empty_backbone(checkpoint: Checkpoint, settings: dict[str, Any] | None = None) -> Backbone:
    """The base's backbone on the meta device: weights come from the files, where they are needed."""
    import torch

    from persist_cli.plugins import make_backbone

    with torch.device("meta"):
        return make_backbone(checkpoint.backbone, checkpoint.settings | (settings or {}))


def load_adapter(backbone: Backbone, checkpoint: Checkpoint, adapter: str | None) -> None:
    """Load an adapter of the checkpoint onto its backbone and use it; ``None`` is plain stage 1."""
    if adapter is None:
        backbone.use_adapter(None)
    else:
        backbone.load_adapter(adapter, checkpoint.adapter_folder(adapter))


def save_base(backbone: Backbone, folder: Path, scenes: TrainingScenes | None = None) -> None:
    """Write the backbone's own files and a card into an existing folder."""
    backbone.save_base(folder)
    card = {"backbone": backbone.name, "settings": backbone.checkpoint_settings(), "fingerprint": fingerprint(folder)}
    write_card(folder, card, scenes)


def save_lora(
    backbone: Backbone, base: Checkpoint | None, folder: Path, home: Path, scenes: TrainingScenes | None = None
) -> None:
    """Write what LoRA trained and a card that points to the base that it changes.

    Args:
        backbone: a backbone with LoRA.
        base: the checkpoint that LoRA was trained on; ``None`` for the pretrained weights in the backbone's settings.
        folder: the existing folder to write into.
        home: the place where that folder will be in the end; the path to the base is relative to it.
        scenes: the scenes that base and LoRA were trained on, where they are known.
    """
    backbone.save_lora(folder)
    changes: dict[str, Any] = {"settings": backbone.origin()}
    if base is not None:
        changes = {"base": _path_to_base(base, home), "fingerprint": base.fingerprint}
    own = hashlib.sha256(f"{fingerprint(folder)} {changes.get('fingerprint')}".encode()).hexdigest()
    card = {"backbone": backbone.name, "settings": backbone.checkpoint_settings()}
    write_card(folder, card | {"changes": changes, "fingerprint": own}, scenes)


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
    """Write the adapter in use and a card that points to its base.

    Args:
        backbone: a backbone that uses the adapter.
        base: the checkpoint that the adapter was trained on.
        memory: the choice of the memory that the adapter reads.
        folder: the existing folder to write into.
        home: the place where that folder will be in the end; the path to the base is relative to it.
        scenes: the scenes that base and adapter were trained on, where they are known.
    """
    adapter = folder / "adapters" / memory.name
    adapter.mkdir(parents=True)
    backbone.save_adapter(adapter)
    write_json(adapter / "memory.json", dataclasses.asdict(memory))
    write_card(folder, {"base": _path_to_base(base, home), "fingerprint": base.fingerprint}, scenes)


def base_files(folder: Path, pattern: str) -> list[Path]:
    """The files under a checkpoint's folder that match a pattern, without those of adapters, sorted by path."""
    files = (path for path in folder.rglob(pattern) if path.is_file())
    return sorted(path for path in files if path.relative_to(folder).parts[0] != "adapters")


def fingerprint(folder: Path) -> str:
    """SHA-256 over all weight files of a checkpoint's base, in order of their paths."""
    digest = hashlib.sha256()
    for path in base_files(folder, "*.safetensors"):
        digest.update(str(path.relative_to(folder)).encode())
        digest.update(bytes.fromhex(file_sha256(path)))
    return digest.hexdigest()


def _path_to_base(base: Checkpoint, home: Path) -> str:
    return os.path.relpath(_home(base.base_folder).resolve(), home.resolve())


def _home(folder: Path) -> Path:
    """The run whose checkpoint a folder is, else the folder itself."""
    return folder.parent.parent if folder.parent.name.startswith(STEP) else folder


def _training_scenes(card: dict[str, Any], path: Path) -> TrainingScenes | None:
    if "training_scenes" not in card:
        return None
    try:
        return TrainingScenes.from_json(card["training_scenes"])
    except ValueError as error:
        raise CheckpointError(f"{path}: its training scenes cannot be read ({error})") from error
