"""The optimizer of a training, the moving average of its weights, and the memory savings of its backbone."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from typing import TYPE_CHECKING

import torch
from torch import nn

from persist_cli.api.stages import MemorySavings
from persist_cli.errors import PersistError
from persist_cli.training_settings import TrainingSettings

if TYPE_CHECKING:
    from diffusers.training_utils import EMAModel

COMPILERS = ("c++", "g++", "clang++")  # what torch.compile looks for on a CPU


def requested_savings(settings: TrainingSettings, device: torch.device) -> MemorySavings:
    """The memory savings that the settings ask of the backbone.

    Raises:
        PersistError: when blocks are to be compiled on a CPU and there is no compiler.
    """
    compilers = (os.environ["CXX"],) if os.environ.get("CXX") else COMPILERS
    if settings.compile and device.type == "cpu" and not any(map(shutil.which, compilers)):
        raise PersistError(
            f"training.compile needs a C++ compiler on a CPU ({' or '.join(compilers)}); install one or leave it out"
        )
    return MemorySavings(
        gradient_checkpointing=settings.gradient_checkpointing,
        compile=settings.compile,
        frozen=torch.bfloat16 if settings.frozen_precision == "bf16" else None,
        vae_slicing=settings.vae_slicing,
    )


def make_optimizer(parameters: Iterable[nn.Parameter], settings: TrainingSettings) -> torch.optim.Optimizer:
    """AdamW with moments of 32 bits, or of 8 bits for ``adamw-8bit``.

    Raises:
        PersistError: when bitsandbytes, which has the one of 8 bits, is not installed.
    """
    rate, decay = settings.learning_rate, settings.weight_decay
    if settings.optimizer == "adamw":
        return torch.optim.AdamW(parameters, lr=rate, weight_decay=decay)
    try:
        from bitsandbytes.optim import AdamW8bit
    except ImportError as error:
        raise PersistError(
            "training.optimizer=adamw-8bit needs the package bitsandbytes: pip install 'persist-cli[bitsandbytes]'"
        ) from error
    optimizer: torch.optim.Optimizer = AdamW8bit(parameters, lr=rate, weight_decay=decay)
    return optimizer


def make_average(parameters: Iterable[nn.Parameter], settings: TrainingSettings) -> EMAModel:
    """The moving average of the parameters, on their device or on the CPU as the settings say."""
    from diffusers.training_utils import EMAModel  # it imports most of diffusers, which takes seconds

    average = EMAModel(parameters, decay=settings.ema, use_ema_warmup=True)
    if settings.ema_device == "cpu":
        average.to("cpu")
    return average


def update_average(average: EMAModel, parameters: Iterable[nn.Parameter]) -> None:
    """Move the average towards the parameters, which may be on another device."""
    device = average.shadow_params[0].device
    # EMAModel averages tensors with requires_grad and copies the others
    average.step([p if p.device == device else p.detach().to(device).requires_grad_() for p in parameters])
