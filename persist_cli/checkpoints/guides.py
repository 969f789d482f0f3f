"""Guides: weaker versions of a video model that an export keeps beside it, for autoguidance."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from persist_cli.api.checkpoint import Checkpoint, lora_base
from persist_cli.checkpoints.load import changed_settings, check_video_model, load_backbone
from persist_cli.errors import CheckpointError
from persist_cli.io.checksums import tensor_checksum
from persist_cli.io.files import read_tensors
from persist_cli.output.console import busy
from persist_cli.plugins import load_plugin


def check_guide(guide: Checkpoint, base: Checkpoint) -> None:
    """Check whether the video model of a checkpoint can guide that of a base.

    Raises:
        CheckpointError: when it has no trained video model, other sizes, inputs or outputs, or another codec.
    """
    place, kind = guide.folder, load_plugin("backbone", base.backbone)
    if not kind.video_model:
        raise CheckpointError(f"backbone {base.backbone!r} has no autoguidance; leave --guide out")
    if guide.backbone != base.backbone:
        raise CheckpointError(f"{place}: of backbone {guide.backbone!r}; its base is of {base.backbone!r}")
    if lora_base(guide.base_folder) is not None:
        raise CheckpointError(f"{place}: LoRA on another base; export it, and name that export as the guide")
    check_video_model(guide)
    with busy("comparing the guide with its base"):
        settings, encoding = _settings_and_codec(guide)
        own = load_backbone(base)
        for name in _differences(settings, own.checkpoint_settings()):
            if name not in kind.for_training:
                raise CheckpointError(
                    f"{place}: another {name} than {base.folder}; a guide has the settings of its base"
                )
        if encoding != own.encoding():
            raise CheckpointError(
                f"{place}: has another codec than {base.folder}, or the same in another precision; a guide shares that "
                "of its base"
            )
        own.check_guide(guide.base_folder)


def guide_files(guide: Checkpoint, home: Path) -> dict[str, Path]:
    """The files of a checkpoint's video model, by their paths in the folder of a guide.

    Args:
        guide: the checkpoint.
        home: the folder of the base that it shall guide, where LoRA is merged into it.

    Raises:
        CheckpointError: when it is the video model of that base itself.
    """
    files = _video_files(guide.base_folder, guide.backbone)
    if _checksums(files) == _checksums(_video_files(home, guide.backbone)):
        raise CheckpointError(
            f"{guide.folder}: its video model is the base itself; a guide is a weaker version, trained less"
        )
    return files


def _settings_and_codec(checkpoint: Checkpoint) -> tuple[dict[str, Any], str]:
    """All settings of a backbone, defaults included, unlike those of a card, and the fingerprint of its codec."""
    backbone = load_backbone(checkpoint)
    return backbone.checkpoint_settings(), backbone.encoding()


def _differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """Names of the settings that differ, whichever of the two has them."""
    return [*changed_settings(one, other), *changed_settings(other, one)]


def _video_files(home: Path, backbone: str) -> dict[str, Path]:
    """The files of the video model in the folder of a base, by their paths there."""
    names = load_plugin("backbone", backbone).video_model
    parts = [path for name in names for path in (home / name, *(home / name).rglob("[!.]*"))]
    return {path.relative_to(home).as_posix(): path for path in sorted(parts) if path.is_file()}


def _checksums(files: Mapping[str, Path]) -> dict[str, str]:
    """The checksums of the weights in some files by name, however they are cut into files and whatever their types."""
    tensors = (read_tensors(path)[0] for name, path in files.items() if name.endswith(".safetensors"))
    return {name: tensor_checksum({name: tensor.half()}, {}) for part in tensors for name, tensor in part.items()}
