"""What a convolution holds on a CPU beside its input and output, as torch 2 has it."""

from __future__ import annotations

import contextlib
import math
import weakref
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final

import torch
import torch.nn.functional as F
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode

SMALL: Final = 20480  # batch × channels × the first two sizes, up to which one thread unfolds

FEW: Final = 16  # samples, from which on it does not


def convolution_bytes(args: Any, out: Tensor, backward: bool, threads: int) -> int:
    """Bytes of workspace.

    oneDNN holds a copy of input or output, the larger, in the order that it works in. One thread leaves small ones
    in float32 to a kernel of torch that unfolds the input: at each place of the output all that the weights see.

    Args:
        args: of ``aten.convolution`` or of its backward, which has the output's gradient before the rest.
        out: the output, or the input's gradient.
        backward: which of the two it is.
        threads: of torch.
    """
    given, weight, stride, dilation = (args[1], args[2], args[4], args[6]) if backward else (*args[:2], *args[3:6:2])
    result = args[0] if backward else out
    plain = all(step == 1 for step in (*stride, *dilation)) and max(weight.shape[-2:]) <= 3
    small = given.shape[0] < FEW and math.prod(given.shape[:4]) <= SMALL
    places, kernel = math.prod(result.shape[2:]), math.prod(weight.shape[2:])
    if threads == 1 and plain and small and given.dtype == torch.float32:
        unfolded: int = given.shape[0] * weight.shape[1] * kernel * places * given.element_size()
        return unfolded if kernel > 1 else 0
    return max(each.numel() * each.element_size() for each in (given, result))


aten = torch.ops.aten

FLOAT32_ON_CUDA = ("layer_norm", "group_norm")  # in autocast; on a CPU they keep their input's precision


class LiveBytes(TorchDispatchMode):
    """Counts the bytes of all tensors that come into being within it, as long as they live; views are nothing new.

    What depends on values that are not there is taken as zero, and no value as masked out. Gradients that are
    ``set_aside`` live on, but count no more towards ``peak``.

    Args:
        known: tensors that are there already and do not count.
        threads: of torch on the CPU, whose convolutions have a workspace (see ``convolution``); ``None`` for CUDA,
            where it is not known.
    """

    def __init__(self, known: Iterable[Tensor], threads: int | None) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.threads = threads
        self.now = self.peak = 0
        self._alive: dict[int, weakref.ref[Any]] = {}
        self._sizes: dict[int, int] = {}
        self._known = {each.untyped_storage()._cdata for each in known}

    def set_aside(self, parameter: Tensor) -> None:
        """Count the parameter's gradient no more."""
        if parameter.grad is not None:
            self._forget(parameter.grad.untyped_storage()._cdata)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run one operation and note what it made."""
        if func is aten._local_scalar_dense.default:
            return 1.0 if args[0].is_floating_point() else 0
        out = _of_all_values(func, args) if func in _BY_VALUES else func(*args, **(kwargs or {}))
        made = [each for each in (out if isinstance(out, tuple | list) else (out,)) if isinstance(each, Tensor)]
        for each in made:
            self._note(each)
        if func in _CONVOLUTIONS and self.threads is not None:
            backward = func is aten.convolution_backward.default
            self.peak = max(self.peak, self.now + convolution_bytes(args, made[0], backward, self.threads))
        return out

    def _note(self, tensor: Tensor) -> None:
        storage = tensor.untyped_storage()
        key = storage._cdata
        if key in self._alive or key in self._known:
            return
        size = storage.nbytes()
        self.now += size
        self.peak = max(self.peak, self.now)
        self._alive[key] = weakref.ref(storage, lambda _: self._forget(key))
        self._sizes[key] = size

    def _forget(self, key: int) -> None:
        del self._alive[key]
        self.now -= self._sizes.pop(key)


_CONVOLUTIONS = {aten.convolution.default, aten.convolution_backward.default}

_BY_VALUES = {aten.nonzero.default, aten.repeat_interleave.Tensor, aten.index.Tensor}


def _of_all_values(func: Any, args: Any) -> Any:
    """What an operation whose result's size depends on values gives when all of them count."""
    if func is aten.nonzero.default:
        return args[0].new_zeros(args[0].numel(), args[0].ndim, dtype=torch.long)
    if func is aten.repeat_interleave.Tensor:
        return args[0].new_zeros(args[0].numel(), dtype=torch.long)
    places: list[Tensor | None] = []
    for index in args[1]:
        chosen = index is not None and index.dtype == torch.bool
        places += [index.new_zeros(index.numel(), dtype=torch.long)] * index.ndim if chosen else [index]
    return func(args[0], places)


@contextlib.contextmanager
def kernels(cuda: bool) -> Iterator[None]:
    """Within the block attention keeps no matrix of all pairs, as on every device, and norms have its precision.

    They are put in torch's own place: a mode of torch's would not hold in what the backward pass computes again.

    Args:
        cuda: whether autocast shall follow CUDA's rules, where tensors are those of the CPU.
    """
    found = {"scaled_dot_product_attention": _attention}
    if cuda:
        found |= {name: _in_float32(getattr(F, name)) for name in FLOAT32_ON_CUDA}
    before = {name: getattr(F, name) for name in found}
    try:
        for name, function in found.items():
            setattr(F, name, function)
        yield
    finally:
        for name, function in before.items():
            setattr(F, name, function)


def _attention(query: Tensor, key: Tensor, value: Tensor, *_: Any, **__: Any) -> Tensor:
    half = torch.is_autocast_enabled("cpu")
    parts = [each.to(torch.bfloat16) if half else each for each in (query, key, value)]
    found: Tensor = aten._scaled_dot_product_flash_attention_for_cpu(*parts)[0]
    return found


def _in_float32(norm: Callable[..., Tensor]) -> Callable[..., Tensor]:
    def exact(value: Any) -> Any:
        return value.float() if isinstance(value, Tensor) else value

    def run(*args: Any, **kwargs: Any) -> Tensor:
        if torch.is_autocast_enabled("cpu"):
            args, kwargs = tuple(map(exact, args)), {name: exact(value) for name, value in kwargs.items()}
        return norm(*args, **kwargs)

    return run


@contextlib.contextmanager
def imagined() -> Iterator[None]:
    """Within the block tensors have no values and take no memory."""
    with FakeTensorMode(allow_non_fake_inputs=True):
        yield
