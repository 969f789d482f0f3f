"""The stages of training a backbone, and what is said of them: its parts, cheaper steps, a change of low rank."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from pydantic import Field
from torch import nn

Stage = Literal["codec", "1", "2"]

STAGES: tuple[Stage, ...] = ("codec", "1", "2")


@dataclass(frozen=True)
class ParameterGroup:
    """Some of a backbone's parameters under a name that people know.

    Args:
        name: of the part.
        parameters: by their names in the backbone.
        new: whether they begin fresh even where the rest is pretrained.
    """

    name: str
    parameters: Mapping[str, nn.Parameter]
    new: bool = False


@dataclass(frozen=True)
class MemorySavings:
    """What makes a training step cheaper and changes nothing but rounding.

    Args:
        gradient_checkpointing: compute hidden states between blocks again in the backward pass.
        compile: the blocks, by ``torch.compile``.
        frozen: precision of the weights that the stage does not train; ``None`` leaves them theirs.
        vae_slicing: encode clips one by one.
    """

    gradient_checkpointing: bool = False
    compile: bool = False
    frozen: torch.dtype | None = None
    vae_slicing: bool = False


@dataclass(frozen=True)
class Lora:
    """A change of low rank that stage 1 trains instead of all weights (LoRA).

    Args:
        rank: of the change of each layer.
        alpha: the change counts alpha / rank; by default as much as the rank.
        targets: ends of the names of the linear layers that are changed.
    """

    rank: Annotated[int, Field(ge=1)] = 64
    alpha: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    targets: Annotated[tuple[str, ...], Field(min_length=1)] = ("to_q", "to_k", "to_v", "to_out.0")
