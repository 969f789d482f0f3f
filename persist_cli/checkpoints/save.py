"""Checkpoints written: bases, LoRA and adapters, each with the card that makes its folder a checkpoint."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from persist_cli.api.checkpoint import CARD, CODEC_ALONE, PACKAGED, STARTED_FROM, VERSION, Checkpoint
from persist_cli.api.inference import CONSISTENCY
from persist_cli.api.training_scenes import TrainingScenes
from persist_cli.checkpoints.lineage import MEMORY_FILE
from persist_cli.io.files import bundled_folder, relative_place, write_json
from persist_cli.io.sha256sums import hash_files, write_sums
from persist_cli.recipe import MemoryConfig

if TYPE_CHECKING:
    from persist_cli.api.backbone import Backbone


def save_base(
    backbone: Backbone,
    folder: Path,
    scenes: TrainingScenes | None = None,
    base: Checkpoint | None = None,
    home: Path | None = None,
    codec_alone: bool = False,
) -> None:
    """Write the backbone's own files, a card and ``SHA256SUMS``.

    Args:
        backbone: the backbone with all of its weights.
        folder: the existing folder to write into, which may hold other files to be listed.
        scenes: the scenes that it was trained on, where they are known.
        base: the checkpoint that the training started from, which a resumed run looks for.
        home: the place where the folder will be in the end, by default the folder itself.
        codec_alone: whether the card says that its video model was not trained.
    """
    backbone.save_base(folder)
    hashes = hash_weights(folder)
    card = {"backbone": backbone.name, "settings": backbone.checkpoint_settings(), "fingerprint": fingerprint(hashes)}
    card |= asked_sampling(backbone, base) | ({CODEC_ALONE: True} if codec_alone else {})
    started = {} if base is None else {STARTED_FROM: pointer_to(base.base_folder, base.fingerprint, home or folder)}
    write_card(folder, card | started, scenes)
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
        changes = pointer_to(base.base_folder, base.fingerprint, home)
    hashes = hash_weights(folder)
    card = {"backbone": backbone.name, "settings": backbone.checkpoint_settings(), "changes": changes}
    card |= asked_sampling(backbone, base)
    write_card(folder, card | {"fingerprint": card_fingerprint(hashes, card)}, scenes)
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
    write_json(adapter / MEMORY_FILE, dataclasses.asdict(memory))
    write_card(folder, pointer_to(base.base_folder, base.fingerprint, home) | own_sampling(backbone), scenes)
    write_sums(folder)


def own_sampling(backbone: Backbone) -> dict[str, Any]:
    """The sampling that a backbone's card asks for, where it has one of its own."""
    sampling = backbone.own_sampling
    return {} if sampling is None else {"sampling": dataclasses.asdict(sampling)}


def asked_sampling(backbone: Backbone, base: Checkpoint | None) -> dict[str, Any]:
    """The sampling that the card of a video model asks for: its own, else that of the base that it was trained on.

    That of a distilled base is not kept, for the training undoes it, and no autoguidance, for the guide is not written.
    """
    own = own_sampling(backbone)
    if own or base is None or (base.sampling is not None and base.sampling.sampler == CONSISTENCY):
        return own
    alone = {"autoguidance": 1.0}
    protocols = {name: dataclasses.asdict(sampling) | alone for name, sampling in base.protocol_sampling.items()}
    kept = {} if base.sampling is None else {"sampling": dataclasses.asdict(base.sampling) | alone}
    return kept | ({"protocol_sampling": protocols} if protocols else {})


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
    for path in sorted(map(PurePosixPath, hashes)):
        digest.update(str(path).encode())
        digest.update(bytes.fromhex(hashes[str(path)]))
    return digest.hexdigest()


def card_fingerprint(hashes: Mapping[str, str], card: dict[str, Any]) -> str:
    """The fingerprint that belongs on the card of a base: that of its weights, and with LoRA also of those it changes.

    Args:
        hashes: SHA-256 of each weight file of the base, as ``hash_weights`` returns them.
        card: the other values of its card.
    """
    if "changes" not in card:
        return fingerprint(hashes)
    return hashlib.sha256(f"{fingerprint(hashes)} {card['changes'].get('fingerprint')}".encode()).hexdigest()


def pointer_to(base: Path, fingerprint: str, home: Path) -> dict[str, str]:
    """The values of a card that point to a base: its folder relative to ``home``, or its name, and its fingerprint."""
    packaged = [name for name in PACKAGED if base.resolve() == bundled_folder(name).resolve()]
    place = packaged[0] if packaged else relative_place(base.resolve(), home.resolve())
    return {"base": place, "fingerprint": fingerprint}
