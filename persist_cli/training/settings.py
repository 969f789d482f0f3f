"""How a stage is trained: steps, batch, optimizer, and what makes a step cheaper."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

Count = Annotated[int, Field(ge=0)]
Positive = Annotated[int, Field(ge=1)]
PositiveNumber = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Amount = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Precision = Annotated[  # YAML reads the word no as false
    Literal["no", "bf16"], BeforeValidator(lambda given: "no" if given is False else given)
]


@dataclass(frozen=True)
class TrainingSettings:
    """How long and how.

    Args:
        steps: optimizer steps.
        batch: samples an optimizer step, over all processes and accumulated micro-batches.
        accumulation: micro-batches that a step is split into.
        learning_rate: of AdamW, after the warm-up.
        warmup: steps of linear warm-up.
        cooldown: steps at the end over which the learning rate falls linearly to zero.
        weight_decay: of AdamW.
        clip: largest gradient norm.
        ema: decay of the averaged weights that are kept; 0 keeps the last ones.
        precision: ``no`` or ``bf16``.
        seed: of weights, samples and noise.
        checkpoint_every: steps between checkpoints.
        checkpoint_minutes: most minutes between checkpoints.
        workers: processes that read data.
        threads: of torch on the CPU; 0 leaves torch's choice.
        tracker: ``none`` or ``tensorboard``.
        optimizer: ``adamw``, or ``adamw-8bit`` of the package bitsandbytes, whose moments take a quarter of the bytes.
        gradient_checkpointing: keep the hidden states between blocks alone and compute the rest again in the backward
            pass: far fewer bytes for about a third more time.
        compile: the blocks by ``torch.compile``; the first steps take minutes.
        ema_device: where the averaged weights are: beside the ``model``, or in the memory of the ``cpu``.
        frozen_precision: ``bf16`` holds what a stage does not train in half the bytes; what is saved stays exact.
        vae_slicing: encode clips one by one.
    """

    steps: Positive = 1000
    batch: Positive = 16
    accumulation: Positive = 1
    learning_rate: PositiveNumber = 1e-4
    warmup: Count = 50
    cooldown: Count = 0
    weight_decay: Amount = 1e-4
    clip: PositiveNumber = 1.0
    ema: Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)] = 0.999
    precision: Precision = "bf16"
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0  # what numpy takes
    checkpoint_every: Positive = 500
    checkpoint_minutes: Amount = 5.0
    workers: Count = 1
    threads: Count = 0
    tracker: Literal["none", "tensorboard"] = "none"
    optimizer: Literal["adamw", "adamw-8bit"] = "adamw"
    gradient_checkpointing: bool = False
    compile: bool = False
    ema_device: Literal["model", "cpu"] = "model"
    frozen_precision: Precision = "no"
    vae_slicing: bool = False

    def samples_at_once(self, processes: int) -> int:
        """Samples of a micro-batch on each of so many processes, the most where they cannot have equal parts."""
        return math.ceil(self.batch / (self.accumulation * processes))
