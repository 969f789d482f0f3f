"""Cheaper training steps: recomputed and compiled blocks, frozen weights in half the bytes."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from persist_backbones.cogvideox.cogvideox import CogVideoX
from persist_backbones.extensions.lora import has_lora
from persist_cli.api.stages import MemorySavings, Stage


class FrozenWeights:
    """The weights of a module that are not trained, held in another precision.

    Args:
        module: the module, whose frozen parameters are converted in place.
        dtype: the precision; ``None`` converts nothing.
        saved: whether the weights will be saved; their exact values then stay in the memory of the CPU.
    """

    def __init__(self, module: nn.Module, dtype: torch.dtype | None, saved: bool = True) -> None:
        self.exact: list[tuple[nn.Parameter, Tensor]] = []
        for parameter in module.parameters() if dtype else ():
            if parameter.requires_grad or parameter.dtype == dtype:
                continue
            if saved:
                self.exact.append((parameter, parameter.data.cpu()))
            parameter.data = parameter.data.to(dtype)

    @contextlib.contextmanager
    def restored(self) -> Iterator[None]:
        """Within the block, the weights have their exact values, on the CPU."""
        converted = [parameter.data for parameter, _ in self.exact]
        try:
            for parameter, exact in self.exact:
                parameter.data = exact
            yield
        finally:
            for (parameter, _), low in zip(self.exact, converted, strict=True):
                parameter.data = low


def apply_memory_savings(backbone: CogVideoX, stage: Stage, savings: MemorySavings) -> FrozenWeights:
    """Make training steps cheaper; exact values of frozen weights are kept if the stage saves them."""
    transformer, adapter = backbone.transformer.base, backbone.adapter
    transformer.gradient_checkpointing = savings.gradient_checkpointing
    blocks = [*transformer.transformer_blocks, *(adapter.blocks.values() if adapter else ())]
    for block in blocks:
        if savings.gradient_checkpointing:
            recompute_in_backward(block)
        if savings.compile:  # block by block, as diffusers' compile_repeated_blocks; the names of weights stay
            block.compile()
    if savings.vae_slicing:
        backbone.codec.vae.enable_slicing()
    return FrozenWeights(backbone, savings.frozen, saved=stage != "2" and not has_lora(transformer))


def recompute_in_backward(block: nn.Module) -> None:
    """Let a block keep only its inputs for the backward pass, in which everything inside is computed again.

    Where no gradient comes through a frozen block, as before the first block of an adapter, there is nothing to
    compute again. It then runs as it is, because torch's compiler refuses to.
    """
    forward, trained = block.forward, any(parameter.requires_grad for parameter in block.parameters())

    def recomputed(*inputs: Any, **named: Any) -> Any:
        tensors = (value for value in (*inputs, *named.values()) if isinstance(value, Tensor))
        if not torch.is_grad_enabled() or not (trained or any(tensor.requires_grad for tensor in tensors)):
            return forward(*inputs, **named)
        return checkpoint(forward, *inputs, use_reentrant=False, **named)

    block.forward = recomputed
