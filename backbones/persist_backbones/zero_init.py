"""What is new begins as if it were not there."""

from __future__ import annotations

from torch import nn


def zero_init(*modules: nn.Module) -> None:
    """Set all parameters of the modules to zero."""
    for module in modules:
        for parameter in module.parameters():
            nn.init.zeros_(parameter)
