"""Whether this processor multiplies in half precision, and whether it is faster or many times slower so."""

from __future__ import annotations

from typing import Final

import torch

NAMES: Final = {torch.bfloat16: "bf16", torch.float16: "fp16"}  # as torch's checks of the processor have them


def is_slow(dtype: torch.dtype) -> bool:
    """Whether torch has no fast matrix product in ``dtype`` on this processor.

    Then it multiplies element by element: 51 times as slow as in float32 on a processor with AVX2 alone. Where torch
    does not know the processor, nothing is said.
    """
    if dtype not in NAMES or not torch.backends.mkldnn.is_available():
        return False
    check = getattr(torch.ops.mkldnn, f"_is_mkldnn_{NAMES[dtype]}_supported", None)
    return check is not None and not check()


def has_bfloat16_tiles() -> bool:
    """Whether this processor multiplies tiles of bfloat16 (AMX), which is several times as fast as float32.

    Processors with instructions for vectors of it alone (AVX512-BF16) multiply matrices faster in float32.
    """
    check = getattr(torch.cpu, "_is_amx_tile_supported", None)
    return torch.backends.mkldnn.is_available() and check is not None and bool(check())
