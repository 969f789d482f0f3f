"""Guides: weaker versions of a video model that an export keeps beside it, for autoguidance."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from persist_cli.api.checkpoint import Checkpoint, lora_base
from persist_cli.checkpoints.load import changed_settings, is_own_codec, load_backbone, takes_codec_alone
from persist_cli.errors import CheckpointError
from persist_cli.io.checksums import tensor_checksum
from persist_cli.io.files import read_tensors
from persist_cli.output.console import busy
from persist_cli.plugins import load_plugin


def guide_files(guide: Checkpoint, base: Checkpoint) -> dict[str, Path]:
    """The files of a checkpoint's video model, by their paths in the folder of a guide."""
    home = guide.base_folder
    names = load_plugin("backbone", base.backbone).video_model
    parts = [path for name in names for path in (home / name, *(home / name).rglob("[!.]*"))]
    return {path.relative_to(home).as_posix(): path for path in sorted(parts) if path.is_file()}


def _weights(files: Mapping[str, Path]) -> dict[str, str]:
    """The checksums of the weights in some files by their names, however they are cut into files."""
    tensors = (read_tensors(path)[0] for name, path in files.items() if name.endswith(".safetensors"))
    return {name: tensor_checksum({name: tensor}, {}) for part in tensors for name, tensor in part.items()}


def check_guide(guide: Checkpoint, base: Checkpoint) -> None:
    """Check whether the video model of a checkpoint can guide that of a base.

    Raises:
        CheckpointError: when it is the same, has other sizes, inputs or outputs, or another codec.
    """
    place, kind = guide.folder, load_plugin("backbone", base.backbone)
    if not kind.video_model:
        raise CheckpointError(f"backbone {base.backbone!r} has no autoguidance; leave --guide out")
    if guide.backbone != base.backbone:
        raise CheckpointError(f"{place}: of backbone {guide.backbone!r}; its base is of {base.backbone!r}")
    if lora_base(guide.base_folder) is not None:
        raise CheckpointError(f"{place}: LoRA on another base; export it, and name that export as the guide")
    if takes_codec_alone(guide) and is_own_codec(guide):
        raise CheckpointError(f"{place}: a codec alone, whose video model was not trained; it cannot guide")
    changed = [name for name in changed_settings(base.settings, guide.settings) if name not in kind.for_training]
    if changed:
        raise CheckpointError(f"{place}: another {changed[0]} than {base.folder}; a guide has the settings of its base")
    if _weights(guide_files(guide, base)) == _weights(guide_files(base, base)):
        raise CheckpointError(f"{place}: its video model is the base itself; a guide is a weaker version, trained less")
    with busy("comparing the codecs"):
        encodings = {load_backbone(checkpoint).encoding() for checkpoint in (guide, base)}
    if len(encodings) > 1:
        raise CheckpointError(
            f"{place}: has another codec than {base.folder}, or the same in another precision; a guide shares that of "
            "its base"
        )
