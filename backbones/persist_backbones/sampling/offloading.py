"""Modules that rest elsewhere than they compute: what accelerate's offload hooks say of them."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn


def computing_device(module: nn.Module) -> torch.device:
    """Where a module computes: the device of the first offload hook in it that names one, else of its weights."""
    for part in module.modules():
        device = getattr(_hook(part), "execution_device", None)
        if device is not None:
            return torch.device(device)
    return next(module.parameters()).device


def bring(module: nn.Module) -> None:
    """Move a module that is offloaded as a whole to where it computes.

    accelerate does so when ``forward`` runs; this is for modules whose parts are run one by one.
    """
    hook = _hook(module)
    if hook is not None:
        hook.pre_forward(module)


def _hook(module: nn.Module) -> Any:
    return getattr(module, "_hf_hook", None)
