"""What a convolution holds on a CPU beside its input and output, as torch 2 has it."""

from __future__ import annotations

import math
from typing import Any, Final

import torch
from torch import Tensor

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
