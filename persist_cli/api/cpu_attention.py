"""Attention of matrix products, for training in bfloat16 on processors.

The backward pass of PyTorch's fused kernel is slow there (``python tests/benchmarks/bench_attention.py``).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import torch
from torch.nn.functional import scaled_dot_product_attention
from torch.overrides import TorchFunctionMode

MOST_WEIGHTS = 1 << 27  # of one attention that are kept for the backward pass


@contextlib.contextmanager
def products_for_training(inputs: torch.Tensor) -> Iterator[None]:
    """Within the block, attention in bfloat16 on a processor is made of matrix products where gradients are wanted.

    They keep all weights of attention until the backward pass, so attention of more than ``MOST_WEIGHTS`` keeps the
    fused kernel, and so do all other devices.

    Args:
        inputs: of the network; their device, and their precision where no autocast is on.
    """
    precision = torch.get_autocast_dtype("cpu") if torch.is_autocast_enabled("cpu") else inputs.dtype
    on_processor = inputs.device.type == "cpu" and precision == torch.bfloat16
    if on_processor and torch.is_grad_enabled():
        with MatrixProducts():
            yield
    else:
        yield


class MatrixProducts(TorchFunctionMode):
    """Within the block, attention of at most ``MOST_WEIGHTS`` weights is made of matrix products in bfloat16.

    PyTorch's own kernel of products looks for rows without any key in all weights, which takes as long as the softmax.
    """

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Sequence[type],
        args: Sequence[Any] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        """Call any other function as it is."""
        kwargs = kwargs or {}
        if func is scaled_dot_product_attention and count_weights(*args, **kwargs) <= MOST_WEIGHTS:
            return attend(*args, **kwargs)
        return func(*args, **kwargs)


def count_weights(query: torch.Tensor, key: torch.Tensor, *_: Any, **__: Any) -> int:
    """Return the number of weights of an attention, one for each query and key; arguments as of PyTorch's function."""
    return query.shape[:-1].numel() * key.shape[-2]


def attend(
    query: torch.Tensor,
    key: torch.Tensor,
    value: torch.Tensor,
    attn_mask: torch.Tensor | None = None,
    dropout_p: float = 0.0,
    is_causal: bool = False,
) -> torch.Tensor:
    """Return attention with all its weights at once, in bfloat16; arguments as of PyTorch's function.

    A mask is true where a query sees a key, and each query must see one. There is no dropout and no causal mask.
    """
    if dropout_p or is_causal or (attn_mask is not None and attn_mask.dtype != torch.bool):
        raise NotImplementedError("attention of matrix products has masks of truth values alone, and no dropout")
    with torch.autocast(query.device.type, enabled=False):
        query, key, value = (part.to(torch.bfloat16) for part in (query, key, value))
        weights = (query * query.shape[-1] ** -0.5) @ key.transpose(-1, -2)
        if attn_mask is not None:
            weights = weights.masked_fill(~attn_mask, -torch.inf)
        attended: torch.Tensor = weights.softmax(-1) @ value
    return attended
