"""Checkpoints: one base and small memory adapters that load onto it by name.

A checkpoint folder holds ``persist.json``, the backbone's own files and ``adapters/NAME/``; that of a stage-2 run
holds adapters only and says where its base is, that of a LoRA run what it changes and where that is. A run folder
stands for its newest checkpoint.
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
from persist_cli.io.checkpoint_folder import CARD as CARD  # the tool has these from here
from persist_cli.io.checkpoint_folder import PLAIN as PLAIN
from persist_cli.io.checkpoint_folder import STEP as STEP
from persist_cli.io.checkpoint_folder import VERSION, adapter_folder, default_adapter, open_checkpoint
from persist_cli.io.checkpoint_folder import step_folders as step_folders
from persist_cli.io.files import file_sha256, read_json, write_json
from persist_cli.io.settings import parse_settings
from persist_cli.recipe import BackboneConfig, MemoryConfig, Recipe

if TYPE_CHECKING:
    from persist_cli.api.backbone import Backbone, Sampling


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
        sampling: what is meant when nothing is asked for; ``None`` when the card says nothing.
        training_scenes: of base and adapters; ``None`` for a card of a version that did not write them down.
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
        """What the adapter's memory is made of."""
        path = self.adapter_folder(adapter) / "memory.json"
        return parse_settings(MemoryConfig, read_json(path), str(path))

    def adapter_folder(self, adapter: str) -> Path:
        """The adapter's folder; a one-line error that names the others when there is none."""
        return adapter_folder(self.folder, self.adapters, adapter)

    def default_adapter(self) -> str | None:
        """The card's default or the only adapter, or none when there is none; an error when one must be chosen."""
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
    """Write the backbone's own files and its card into an existing folder."""
    backbone.save_base(folder)
    card = {"backbone": backbone.name, "settings": backbone.checkpoint_settings(), "fingerprint": fingerprint(folder)}
    write_card(folder, card, scenes)


def save_lora(
    backbone: Backbone, base: Checkpoint | None, folder: Path, home: Path, scenes: TrainingScenes | None = None
) -> None:
    """Write what LoRA trained and a card that points to what it changes.

    Args:
        backbone: with LoRA.
        base: what it was trained on; ``None`` for the pretrained weights that the backbone's settings bring.
        folder: to write into.
        home: where the folder will stand in the end.
        scenes: that base and LoRA were trained on, where they are known.
    """
    backbone.save_lora(folder)
    changes: dict[str, Any] = {"settings": backbone.origin()}
    if base is not None:
        changes = {"base": _way(base, home), "fingerprint": base.fingerprint}
    own = hashlib.sha256(f"{fingerprint(folder)} {changes.get('fingerprint')}".encode()).hexdigest()
    card = {"backbone": backbone.name, "settings": backbone.checkpoint_settings()}
    write_card(folder, card | {"changes": changes, "fingerprint": own}, scenes)


def write_card(folder: Path, card: dict[str, Any], scenes: TrainingScenes | None) -> None:
    """Write ``persist.json``, which makes a folder a checkpoint."""
    known = {} if scenes is None else {"training_scenes": scenes.to_json()}
    write_json(folder / CARD, {"format": "persist-checkpoint", "version": VERSION} | card | known)


def save_adapter(
    backbone: Backbone,
    base: Checkpoint,
    choice: MemoryConfig,
    folder: Path,
    home: Path,
    scenes: TrainingScenes | None = None,
) -> None:
    """Write the adapter in use and a card that points to its base.

    Args:
        backbone: with the adapter in use.
        base: what the adapter was trained on.
        choice: its memory.
        folder: to write into.
        home: where the folder will stand in the end; the way to the base is relative to it.
        scenes: that base and adapter were trained on, where they are known.
    """
    adapter = folder / "adapters" / choice.name
    adapter.mkdir(parents=True)
    backbone.save_adapter(adapter)
    write_json(adapter / "memory.json", dataclasses.asdict(choice))
    write_card(folder, {"base": _way(base, home), "fingerprint": base.fingerprint}, scenes)


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


def _way(base: Checkpoint, home: Path) -> str:
    """The way from a checkpoint folder to what it stands on."""
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


def reference_checkpoint() -> Path:
    """The folder of the reference model, a checkpoint with an adapter for each memory.

    Raises:
        CheckpointError: when this installation has none.
    """
    folder = bundled_folder("reference")
    if not (folder / CARD).is_file():
        raise CheckpointError(f"no reference model in {folder}: it comes with the package; give a CHECKPOINT")
    return folder
