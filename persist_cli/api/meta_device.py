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

    As ``torch.device("meta")``, but weights are not initialised, for which torch would first import its compiler; that
    takes over a second.
    """
    with torch.device("meta"), _Uninitialised():
        yield


class _Uninitialised(TorchFunctionMode):
    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None) -> Any:
        if getattr(func, "__module__", "") == "torch.nn.init":
            return args[0] if args else (kwargs or {})["tensor"]
        return func(*args, **(kwargs or {}))
