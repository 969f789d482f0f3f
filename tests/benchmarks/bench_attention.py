"""How long attention takes on a processor, forward and backward, fused and as matrix products (in bfloat16).

``python tests/benchmarks/bench_attention.py [--batch N] [--heads N] [--tokens N] [--rounds N]``
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial

import torch
from torch.nn.functional import scaled_dot_product_attention

from persist_cli.api.cpu_attention import attend
from persist_cli.output.console import print_table
from tests.benchmarks.timing import alternate, say_conditions

CHANNELS = 64  # of a head
KERNELS = {"fused": scaled_dot_product_attention, "products": attend}


def run(kernel: Callable[..., torch.Tensor], queries: torch.Tensor, backward: bool) -> None:
    """Attention of tokens to themselves, with gradients where they are wanted."""
    with torch.set_grad_enabled(backward):
        attended = kernel(queries, queries, queries)
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
    shape = options.batch, options.heads, options.tokens, CHANNELS
    functions: dict[tuple[str, bool], Callable[[], None]] = {}
    queries = torch.randn(shape).to(torch.bfloat16).requires_grad_()
    for name, kernel in KERNELS.items():
        for backward in (False, True):
            functions[name, backward] = partial(run, kernel, queries, backward)
    times = alternate(functions, options.rounds)
    say_conditions(f"attention of {shape} to itself")
    rows = []
    for name, backward in functions:
        ratio = times.ratio((name, backward), ("fused", backward))
        seconds = times.median((name, backward))
        what = "forward and backward" if backward else "forward"
        rows.append([what, name, f"{1000 * seconds:.0f}", f"{ratio:.2f}"])
    print_table("", ["what", "kernel", "ms", "× fused"], rows)


if __name__ == "__main__":
    main()
