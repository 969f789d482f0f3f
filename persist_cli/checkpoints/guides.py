"""Guides: weaker versions of a video model that an export keeps beside it, for autoguidance."""

from __future__ import annotations

from pathlib import Path

from persist_cli.api.checkpoint import Checkpoint, find_checkpoint, lora_base
from persist_cli.checkpoints.load import changed_settings, load_backbone
from persist_cli.errors import CheckpointError
from persist_cli.output.console import busy, warn


def find_guide(place: Path, base: Checkpoint) -> dict[str, Path]:
    """The files of a checkpoint's video model, which shall guide that of a base.

    Args:
        place: a run or a checkpoint's folder.
        base: the base.

    Returns:
        The files by their paths in the guide's folder.

    Raises:
        CheckpointError: when it cannot guide this base.
    """
    guide = find_checkpoint(place)
    if guide.backbone != base.backbone:
        raise CheckpointError(f"{place}: of backbone {guide.backbone!r}; its base is of {base.backbone!r}")
    if lora_base(guide.base_folder) is not None:
        raise CheckpointError(f"{place}: LoRA on another base; export it, and name that export as the guide")
    with busy("loading base and guide"):
        weaker, model = load_backbone(guide), load_backbone(base)
    if not model.video_model:
        raise CheckpointError(f"backbone {base.backbone!r} has no autoguidance; leave --guide out")
    changed = changed_settings(base.settings, guide.settings)
    sizes = [name for name in changed if name.partition(".")[0] in model.built_by]
    if sizes:
        raise CheckpointError(f"{place}: a guide has the sizes of its base; another is {', '.join(sizes)}")
    if weaker.encoding() != model.encoding():
        raise CheckpointError(f"{place}: has another codec than {base.folder}; a guide shares that of its base")
    if changed:
        warn(f"warning: {place}: the guide has other settings than its base: {', '.join(changed)}")
    home = guide.base_folder
    parts = [path for name in model.video_model for path in (home / name, *(home / name).rglob("[!.]*"))]
    return {path.relative_to(home).as_posix(): path for path in sorted(parts) if path.is_file()}
