"""The bytes of memory that operations take, counted while they run on fake tensors: these have shapes and no values."""

from __future__ import annotations

import contextlib
import math
import warnings
import weakref
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final

import torch
import torch.nn.functional as F
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode

# torch unfolds the input of a convolution on one thread when samples are fewer than FEW and the input is SMALL
FEW: Final = 16
SMALL: Final = 20480  # batch × channels × the first two sizes

FLOAT32_ON_CUDA: Final = ("layer_norm", "group_norm")  # in autocast; on a CPU they keep their input's precision

aten = torch.ops.aten

CONVOLUTIONS: Final = {aten.convolution.default, aten.convolution_backward.default}

SIZED_BY_VALUES: Final = {aten.nonzero.default, aten.repeat_interleave.Tensor, aten.index.Tensor}


@contextlib.contextmanager
def fake_tensors() -> Iterator[None]:
    """Within the block new tensors have no values and take no memory."""
    with FakeTensorMode(allow_non_fake_inputs=True), warnings.catch_warnings():
        # a codec compares where its weights are, to sum them up again when they change; fake ones are nowhere
        warnings.filterwarnings("ignore", "Accessing the data pointer of FakeTensor")
        yield


class LiveBytes(TorchDispatchMode):
    """Within its block, counts the bytes of all new tensors as long as they live; views take none.

    Where a result depends on values, which fake tensors lack, a number is taken as 0 or 1 and no element as masked out.
    Gradients that are ``set_aside`` live on, but no longer count towards ``peak``.

    Args:
        known: tensors that exist already and do not count.
        threads: the number of torch's threads on the CPU, where convolutions have a workspace (see
            ``convolution_bytes``); ``None`` for CUDA, where the workspace is not known.
    """

    def __init__(self, known: Iterable[Tensor], threads: int | None) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.threads = threads
        self.now = self.peak = 0
        self._alive: dict[int, weakref.ref[Any]] = {}
        self._sizes: dict[int, int] = {}
        self._known = {tensor.untyped_storage()._cdata for tensor in known}

    def set_aside(self, parameter: Tensor) -> None:
        """Stop to count the parameter's gradient."""
        if parameter.grad is not None:
            self._forget(parameter.grad.untyped_storage()._cdata)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run one operation and count the tensors that it makes."""
        if func is aten._local_scalar_dense.default:
            return 1.0 if args[0].is_floating_point() else 0
        out = _largest_result(func, args) if func in SIZED_BY_VALUES else func(*args, **(kwargs or {}))
        results = [value for value in (out if isinstance(out, tuple | list) else (out,)) if isinstance(value, Tensor)]
        for tensor in results:
            self._count(tensor)
        if func in CONVOLUTIONS and self.threads is not None:
            backward = func is aten.convolution_backward.default
            self.peak = max(self.peak, self.now + convolution_bytes(args, results[0], backward, self.threads))
        return out

    def _count(self, tensor: Tensor) -> None:
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


def convolution_bytes(args: Any, out: Tensor, backward: bool, threads: int) -> int:
    """Bytes of workspace of a convolution on a CPU, as torch 2 has it.

    oneDNN holds a copy of input or output, the larger one, in the order of elements that it works in. With one thread
    torch runs small convolutions in float32 itself: it unfolds the input into all that the kernel covers at each place
    of the output.

    Args:
        args: the arguments of ``aten.convolution``, or of its backward, which has the output's gradient before them.
        out: the output, or the input's gradient.
        backward: whether it is the backward operation.
        threads: the number of torch's threads.
    """
    image, weight, stride, dilation = (args[1], args[2], args[4], args[6]) if backward else (*args[:2], *args[3:6:2])
    output = args[0] if backward else out
    plain = all(step == 1 for step in (*stride, *dilation)) and max(weight.shape[-2:]) <= 3
    small = image.shape[0] < FEW and math.prod(image.shape[:4]) <= SMALL
    places, kernel = math.prod(output.shape[2:]), math.prod(weight.shape[2:])
    if threads == 1 and plain and small and image.dtype == torch.float32:
        unfolded: int = image.shape[0] * weight.shape[1] * kernel * places * image.element_size()
        return unfolded if kernel > 1 else 0
    return max(tensor.numel() * tensor.element_size() for tensor in (image, output))


@contextlib.contextmanager
def device_kernels(cuda: bool) -> Iterator[None]:
    """Within the block attention keeps no matrix of all pairs, as on every device, and norms have its precision.

    The functions are replaced in torch itself: a mode of torch would not hold in what the backward pass computes again.

    Args:
        cuda: whether autocast follows the rules of CUDA, although tensors are on the CPU.
    """
    replaced = {"scaled_dot_product_attention": _attention}
    if cuda:
        replaced |= {name: _in_float32(getattr(F, name)) for name in FLOAT32_ON_CUDA}
    originals = {name: getattr(F, name) for name in replaced}
    try:
        for name, function in replaced.items():
            setattr(F, name, function)
        yield
    finally:
        for name, function in originals.items():
            setattr(F, name, function)


def _largest_result(func: Any, args: Any) -> Any:
    """The result of an operation whose size depends on values, when no element is masked out."""
    if func is aten.nonzero.default:
        return args[0].new_zeros(args[0].numel(), args[0].ndim, dtype=torch.long)
    if func is aten.repeat_interleave.Tensor:
        return args[0].new_zeros(args[0].numel(), dtype=torch.long)
    indices: list[Tensor | None] = []
    for index in args[1]:
        is_mask = index is not None and index.dtype == torch.bool
        indices += [index.new_zeros(index.numel(), dtype=torch.long)] * index.ndim if is_mask else [index]
    return func(args[0], indices)


def _attention(query: Tensor, key: Tensor, value: Tensor, *_: Any, **__: Any) -> Tensor:
    inputs: Iterable[Tensor] = (query, key, value)
    if torch.is_autocast_enabled("cpu"):
        inputs = [tensor.to(torch.bfloat16) for tensor in inputs]
    attended: Tensor = aten._scaled_dot_product_flash_attention_for_cpu(*inputs)[0]
    return attended


def _in_float32(norm: Callable[..., Tensor]) -> Callable[..., Tensor]:
    def exact(value: Any) -> Any:
        return value.float() if isinstance(value, Tensor) else value

    def run(*args: Any, **kwargs: Any) -> Tensor:
        if torch.is_autocast_enabled("cpu"):
            args, kwargs = tuple(map(exact, args)), {name: exact(value) for name, value in kwargs.items()}
        return norm(*args, **kwargs)

    return run
