"""What of a CogVideoX world model stands in a checkpoint folder: all of it, or what LoRA changed."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from persist_backbones.weights.diffusers_parts import load_parts
from persist_backbones.weights.lora import merge_lora, save_lora
from persist_backbones.weights.parts import load_world, save_world, starting_parts
from persist_backbones.weights.prompt import check_kept
from persist_cli.world.checkpoint_folder import what_is_changed

if TYPE_CHECKING:
    from persist_backbones.cogvideox import CogVideoX


def save_whole(backbone: CogVideoX, folder: Path) -> None:
    """Write diffusers' parts, each loadable by diffusers alone, and ``world.safetensors`` with what is ours."""
    with backbone.frozen.restored():
        backbone.transformer.base.save_pretrained(folder / "transformer")
        backbone.codec.vae.save_pretrained(folder / "vae")
        backbone.scheduler.save_pretrained(folder / "scheduler")
        save_world(backbone.transformer, backbone.prompt, folder)


def save_change(backbone: CogVideoX, folder: Path) -> None:
    """Write LoRA as diffusers' pipelines load it, and ``world.safetensors`` with what is ours."""
    save_lora(backbone.transformer.base, folder)
    save_world(backbone.transformer, backbone.prompt, folder)


def load_whole(backbone: CogVideoX, folder: Path) -> None:
    """Take what ``save_whole`` wrote, or what ``save_change`` did merged into the weights that it changes."""
    check_kept(backbone.settings, folder)
    changed = what_is_changed(folder)
    if changed is None:
        backbone.set_parts(load_parts(folder))
    elif isinstance(changed, Path):
        load_whole(backbone, changed)
    else:
        backbone.set_parts(starting_parts(dataclasses.replace(backbone.settings, **changed)))
    if backbone.prompt.is_meta:
        return
    if changed is not None:
        merge_lora(backbone.transformer.base, folder, check=not isinstance(changed, Path))  # a base has a fingerprint
    backbone.prompt = load_world(backbone.transformer, folder)
