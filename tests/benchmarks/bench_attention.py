"""How long attention takes on a processor, forward and backward, fused and as matrix products.

``python tests/benchmarks/bench_attention.py [--batch N] [--heads N] [--tokens N] [--rounds N]``
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial

import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.nn.functional import scaled_dot_product_attention

from persist_cli.viewing.console import print_table
from tests.benchmarks.timing import alternate, say_conditions

CHANNELS = 64  # of a head
KERNELS = {"fused": SDPBackend.FLASH_ATTENTION, "products": SDPBackend.MATH}


def run(kernel: SDPBackend, queries: torch.Tensor, backward: bool) -> None:
    """Attention of tokens to themselves, with gradients where they are wanted."""
    with sdpa_kernel(kernel), torch.set_grad_enabled(backward):
        attended = scaled_dot_product_attention(queries, queries, queries)
    if backward:
        attended.backward(torch.ones_like(attended))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--heads", type=int, default=3)
    parser.add_argument("--tokens", type=int, default=577)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    torch.backends.cuda.allow_fp16_bf16_reduction_math_sdp(True)
    shape = options.batch, options.heads, options.tokens, CHANNELS
    functions: dict[tuple[str, torch.dtype, bool], Callable[[], None]] = {}
    for precision in (torch.float32, torch.bfloat16):
        queries = torch.randn(shape).to(precision).requires_grad_()
        for name, kernel in KERNELS.items():
            for backward in (False, True):
                functions[name, precision, backward] = partial(run, kernel, queries, backward)
    times = alternate(functions, options.rounds)
    say_conditions(f"attention of {shape} to itself")
    rows = []
    for name, precision, backward in functions:
        ratio = times.ratio((name, precision, backward), ("fused", precision, backward))
        seconds = times.median((name, precision, backward))
        what = "forward and backward" if backward else "forward"
        rows.append([str(precision).removeprefix("torch."), what, name, f"{1000 * seconds:.0f}", f"{ratio:.2f}"])
    print_table("", ["precision", "what", "kernel", "ms", "× fused"], rows)


if __name__ == "__main__":
    main()
