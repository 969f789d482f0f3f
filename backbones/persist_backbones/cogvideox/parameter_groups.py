"""The parameters of a CogVideoX world model by part, and the truncation of its layers."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from torch import nn

from persist_backbones.adapters.base import Adapter
from persist_cli.api.stages import ParameterGroup

LORA = ".lora_"  # in the names that PEFT gives to its parameters
ADAPTER = "memory adapter "
DISCRIMINATOR = "discriminator."  # before the names of parameters that are there in adversarial training alone


def group_parameters(parameters: Iterable[tuple[str, nn.Parameter]]) -> list[ParameterGroup]:
    """Group parameters by part: VAE, transformer, LoRA, widening and each memory adapter; empty groups are left out.

    Args:
        parameters: all parameters of the backbone by name.
    """
    parts: dict[str, dict[str, nn.Parameter]] = {}
    new_parts: set[str] = set()
    for name, parameter in parameters:
        part, new = _part_of(name)
        parts.setdefault(part, {})[name] = parameter
        new_parts |= {part} if new else set()
    order = sorted(parts, key=lambda part: part.startswith(ADAPTER))  # adapters come last
    return [ParameterGroup(part, parts[part], part in new_parts) for part in order]


def _part_of(name: str) -> tuple[str, bool]:
    """Return the part of a parameter, and whether that part is new."""
    if name.startswith("codec."):
        return "codec", False
    if name.startswith(DISCRIMINATOR):
        return "discriminator", True
    if LORA in name:
        return "LoRA", True
    if name.startswith("transformer.base."):
        return "transformer", False
    if name.startswith("adapters."):
        return ADAPTER + name.split(".")[1], True
    return "widening", True


def truncate_layers(blocks: nn.ModuleList, adapter: Adapter[Any] | None, groups: int) -> float:
    """Drop all but the first groups of transformer blocks, where each group has one block of the adapter.

    Returns:
        The number of groups before.
    """
    every = adapter.settings.every if adapter else 1
    before = len(blocks) / every
    del blocks[groups * every :]
    if adapter is not None:
        for layer in [name for name in adapter.blocks if int(name) >= groups * every]:
            del adapter.blocks[layer]
    return before
