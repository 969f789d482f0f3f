"""Models without weights: on the meta device, where a tensor has a shape and no values."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import torch
from torch.overrides import TorchFunctionMode


@contextlib.contextmanager
def without_weights() -> Iterator[None]:
    """Within the block models are made on the meta device, for weights that are read from files later.

    As ``torch.device("meta")``, but weights are not initialised, and ranges of numbers are made on the CPU, so that
    tables of positions have values. For both of these torch would first import its compiler, which takes over a second.
    """
    with torch.device("meta"), _Shapes():
        yield


class _Shapes(TorchFunctionMode):
    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None) -> Any:
        kwargs = kwargs or {}
        if getattr(func, "__module__", "") == "torch.nn.init":
            return args[0] if args else kwargs["tensor"]
        if func is torch.arange and kwargs.get("device") is None:
            kwargs = kwargs | {"device": "cpu"}
        return func(*args, **kwargs)
