"""Where and how precisely a network is run, checked before anything is loaded."""

from __future__ import annotations

import torch

from persist_cli.api.half_precision import is_slow
from persist_cli.api.inference import InferenceOptions
from persist_cli.output.console import warn


def check_placement(placement: InferenceOptions) -> None:
    """Warn of a precision that this processor is slow in.

    Raises:
        PersistError: when there is no accelerator, but the placement needs one.
    """
    if placement.device().type == "cpu" and placement.dtype is not None:
        warn_if_slow(f"--dtype {placement.dtype}", getattr(torch, placement.dtype), "leave it out")


def warn_if_slow(setting: str, dtype: torch.dtype, instead: str) -> None:
    """Warn when this processor is slow in a precision.

    Args:
        setting: what the user wrote.
        dtype: the precision that it means.
        instead: what to do about it.
    """
    if is_slow(dtype):
        warn(
            f"{setting}: this processor has no instructions for it and is many times slower than in float32; {instead}"
        )
