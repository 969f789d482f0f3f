"""Muon whose steps take no bfloat16 on a CPU that is slow in it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from persist_cli.api.half_precision import has_bfloat16_tiles


class Muon(torch.optim.Muon):
    """torch's Muon (Jordan et al., 2024), whose steps are made orthogonal in float32 where bfloat16 is slow.

    torch always takes bfloat16. On processors without tiles of it (AMX) that takes 1.7 times as long as float32 and
    more, and without any instructions for it most of a training step of a small model. Steps are as large as those of
    AdamW usually are (``match_rms_adamw`` of Liu et al., 2502.16982).

    Args:
        parameters: matrices.
        lr: learning rate.
        weight_decay: decoupled weight decay.
    """

    def __init__(self, parameters: Iterable[nn.Parameter], lr: float, weight_decay: float) -> None:
        super().__init__(parameters, lr=lr, weight_decay=weight_decay, adjust_lr_fn="match_rms_adamw")

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> Any:
        """Make a step of every parameter that has a gradient."""
        devices = {parameter.device.type for group in self.param_groups for parameter in group["params"]}
        if devices != {"cpu"} or has_bfloat16_tiles():
            return super().step(closure)  # type: ignore[no-untyped-call]
        loss = None if closure is None else closure()
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None:
                    self._move(parameter, parameter.grad, group)
        return loss

    def _move(self, parameter: Tensor, gradient: Tensor, group: dict[str, Any]) -> None:
        state, momentum = self.state[parameter], group["momentum"]
        if "momentum_buffer" not in state:
            state["momentum_buffer"] = torch.zeros_like(gradient)
        mean = state["momentum_buffer"].lerp_(gradient, 1 - momentum)
        direction = orthogonal(gradient.lerp(mean, momentum), group["ns_coefficients"], group["ns_steps"], group["eps"])
        parameter.mul_(1 - group["lr"] * group["weight_decay"])
        parameter.add_(direction, alpha=-0.2 * math.sqrt(max(parameter.shape)) * group["lr"])


def orthogonal(
    matrix: Float[Tensor, "row column"], coefficients: tuple[float, float, float], steps: int, least: float
) -> Float[Tensor, "row column"]:
    """Return a matrix whose singular values are pulled towards 1, by Newton–Schulz iterations in float32.

    Args:
        matrix: the matrix.
        coefficients: of a singular value, its third and its fifth power in each iteration.
        steps: number of iterations.
        least: norm that the matrix is divided by at least.
    """
    first, third, fifth = coefficients
    tall = matrix.shape[0] > matrix.shape[1]
    wide = matrix.float().T if tall else matrix.float()
    wide = wide / wide.norm().clamp(min=least)
    for _ in range(steps):
        squares = wide @ wide.T
        squares = torch.addmm(squares, squares, squares, beta=third, alpha=fifth)
        wide = torch.addmm(wide, squares, wide, beta=first)
    return wide.T if tall else wide
