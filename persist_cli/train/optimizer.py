"""The optimizer of a training, the moving average of its weights, and the memory savings of its backbone."""

from __future__ import annotations

import itertools
import os
import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import torch
from torch import nn

from persist_cli.api.stages import MemorySavings
from persist_cli.errors import PersistError
from persist_cli.train.muon import Muon
from persist_cli.training_settings import TrainingSettings

if TYPE_CHECKING:
    from diffusers.training_utils import EMAModel

LEAST_SIDE: Final = 128  # rows and columns of a matrix that Muon trains

OPPONENT_BETAS: Final = (0.0, 0.99)  # as of StyleGAN's discriminator

SCALE: Final = "scale"  # key of a group of parameters: its learning rate as a multiple of the training's

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


@dataclass(frozen=True)
class Opponent:
    """What a model is trained against: a network with an AdamW of its own, which keeps no mean of its gradients.

    Args:
        parameters: its parameters.
        learning_rate: its learning rate, which rises and falls as the model's does.
    """

    parameters: Sequence[nn.Parameter]
    learning_rate: float


def make_optimizer(
    parameters: Iterable[nn.Parameter], settings: TrainingSettings, opponent: Opponent | None = None
) -> torch.optim.Optimizer:
    """AdamW with moments of 32 bits, or of 8 bits for ``adamw-8bit``; or Muon for the large matrices.

    Args:
        parameters: all that are trained, those of the opponent too.
        settings: optimizer, learning rate and weight decay.
        opponent: what the model is trained against, if anything.

    Raises:
        PersistError: when bitsandbytes, which has the one of 8 bits, is not installed, or no matrix is large.
    """
    if opponent is None:
        return optimizer_of(parameters, settings)
    others = {id(parameter) for parameter in opponent.parameters}
    own = optimizer_of([parameter for parameter in parameters if id(parameter) not in others], settings)
    against = torch.optim.AdamW(opponent.parameters, betas=OPPONENT_BETAS, weight_decay=0.0)
    against.param_groups[0][SCALE] = opponent.learning_rate / settings.learning_rate
    return Together([own, against])


def optimizer_of(parameters: Iterable[nn.Parameter], settings: TrainingSettings) -> torch.optim.Optimizer:
    """The optimizer that the settings name; arguments and errors as of ``make_optimizer``."""
    rate, decay = settings.learning_rate, settings.weight_decay
    if settings.optimizer == "muon":
        return MuonAndAdamW(parameters, rate, decay)
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


class Together(torch.optim.Optimizer):
    """Several optimizers as one, each with parameters of its own.

    Args:
        parts: the optimizers.
    """

    def __init__(self, parts: Sequence[torch.optim.Optimizer]) -> None:
        self.parts = parts
        super().__init__([dict(group) for part in parts for group in part.param_groups], {})

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> Any:
        """Let each make a step; groups and state are this optimizer's own, which others may have replaced."""
        loss, groups = None if closure is None else closure(), iter(self.param_groups)
        for part in self.parts:
            part.param_groups, part.state = [*itertools.islice(groups, len(part.param_groups))], self.state
            part.step()
        return loss


class MuonAndAdamW(Together):
    """Muon for large matrices, AdamW for all else, in one optimizer with one learning rate.

    Muon (Jordan et al., 2024, https://kellerjordan.github.io/posts/muon) makes the steps of a matrix orthogonal. They
    are as large as those of AdamW usually are (``match_rms_adamw`` of Liu et al., 2502.16982), so its learning rates
    serve. Everything else is for AdamW: vectors, convolutions, and matrices with fewer rows or columns.

    Args:
        parameters: the trained parameters.
        rate: learning rate of both.
        decay: weight decay of both.

    Raises:
        PersistError: when no parameter is a matrix of ``LEAST_SIDE`` rows and columns.
    """

    def __init__(self, parameters: Iterable[nn.Parameter], rate: float, decay: float) -> None:
        large: list[nn.Parameter] = []
        others: list[nn.Parameter] = []
        for parameter in parameters:
            (large if parameter.ndim == 2 and min(parameter.shape) >= LEAST_SIDE else others).append(parameter)
        if not large:
            size = f"{LEAST_SIDE} rows and columns"
            raise PersistError(f"training.optimizer=muon trains matrices of {size}, and there are none; use adamw")
        parts: list[torch.optim.Optimizer] = [Muon(large, lr=rate, weight_decay=decay)]
        if others:
            parts.append(torch.optim.AdamW(others, lr=rate, weight_decay=decay))
        super().__init__(parts)


def set_learning_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
    """Give the model's parameters a learning rate, and an opponent's its own in proportion."""
    for group in optimizer.param_groups:
        group["lr"] = rate * group.get(SCALE, 1.0)


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
