"""What a CogVideoX world model is made of: its parameters by part."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from torch import nn

from persist_backbones.adapters.base import Adapter
from persist_cli.api.stages import ParameterGroup

LORA = ".lora_"  # in the names that PEFT gives to what it adds

ADAPTER = "memory adapter "


def group_parameters(parameters: Iterable[tuple[str, nn.Parameter]]) -> list[ParameterGroup]:
    """The VAE, diffusers' transformer, LoRA, what widens the transformer, and each memory adapter; empty ones left out.

    Args:
        parameters: all of the backbone by name.
    """
    found: dict[str, dict[str, nn.Parameter]] = {}
    fresh: set[str] = set()
    for name, parameter in parameters:
        part, new = _part_of(name)
        found.setdefault(part, {})[name] = parameter
        fresh |= {part} if new else set()
    order = sorted(found, key=lambda part: part.startswith(ADAPTER))  # adapters stand last
    return [ParameterGroup(part, found[part], part in fresh) for part in order]


def _part_of(name: str) -> tuple[str, bool]:
    """The part that a parameter belongs to, and whether it is new."""
    if name.startswith("codec."):
        return "codec", False
    if LORA in name:
        return "LoRA", True
    if name.startswith("transformer.base."):
        return "transformer", False
    if name.startswith("adapters."):
        return ADAPTER + name.split(".")[1], True
    return "widening", True


def truncate_layers(blocks: nn.ModuleList, adapter: Adapter[Any] | None, groups: int) -> float:
    """Drop all but the first groups of transformer blocks, a group being as many as one block of the adapter stands at.

    Returns:
        How many groups there were.
    """
    every = adapter.settings.every if adapter else 1
    before = len(blocks) / every
    del blocks[groups * every :]
    if adapter is not None:
        for layer in [each for each in adapter.blocks if int(each) >= groups * every]:
            del adapter.blocks[layer]
    return before
