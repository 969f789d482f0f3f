"""What attention to the paper's tokens has learned: ``python tests/benchmarks/bench_paper_attention.py CHECKPOINT``.

    persist collect miniworld --out runs/held-out --scenes 0:12 --frames 129 --split validation --policy path
    python tests/benchmarks/bench_paper_attention.py runs/gain/houses-64-paper --data runs/held-out

Predicts a clip of each trajectory, whose memory holds all frames before it, with four steps of UniPC. Prints a table
with a row for each memory block of an adapter of the form ``cross``, asserts nothing: how many tokens there were, as
how many equal ones the attention is spread, how much of it is another query's too, and how large what it adds is.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_backbones.adapters.memory_block import MemoryBlock
from persist_cli.api.backbone import Clip, Clips, Sampling
from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.checkpoints.load import adapter_memory, load_backbone
from persist_cli.data.store import Store
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.output.console import print_table

FRAMES = 9
COLUMNS = ("block", "tokens", "as many equal ones", "attention that all queries share", "added, of the video")


def attention(block: MemoryBlock, query: Tensor, context: Tensor, mask: Tensor) -> Tensor:
    """The attention ``[batch, head, query, token]`` of a block without codes of keys."""
    q, k = block.to_query(query), block.to_key(context)
    q, k = (part.unflatten(-1, (block.heads, -1)).transpose(1, 2) for part in (q, k))
    scores = q @ k.transpose(-1, -2) / math.sqrt(q.shape[-1])
    return scores.masked_fill(~mask[:, None, None], -math.inf).softmax(-1)


def watch(blocks: nn.ModuleDict, found: dict[str, list[list[float]]]) -> None:
    """Let every block add its figures to ``found`` whenever it attends to tokens."""
    for name, block in blocks.items():

        def watched(
            query: Tensor, context: Tensor, mask: Tensor, codes: Any = None, *, own: Any = block, key: str = name
        ) -> Tensor:
            added: Tensor = type(own).attend(own, query, context, mask, codes)
            if mask.any():
                shares = attention(own, query, context, mask)
                spread = (-(shares * shares.clamp_min(1e-12).log()).sum(-1)).exp()
                common = torch.minimum(shares, shares.mean(2, keepdim=True)).sum(-1)
                video = query[..., : added.shape[-1]]  # normalised: its root mean square is near 1
                sizes = added.square().mean().sqrt(), video.square().mean().sqrt()
                found.setdefault(key, []).append(
                    [float(mask.sum()), float(spread.mean()), float(common.mean()), float(sizes[0] / sizes[1])]
                )
            return added

        block.attend = watched  # type: ignore[method-assign]


def main() -> None:
    """Predict the clips, and print one table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--clips", type=int, default=8)
    options = parser.parse_args()
    checkpoint = find_checkpoint(options.checkpoint)
    (name,) = checkpoint.adapters
    backbone: Any = load_backbone(checkpoint, adapter=name)
    factory = MemoryFactory.of(adapter_memory(checkpoint, name))
    found: dict[str, list[list[float]]] = {}
    watch(backbone.adapter.blocks, found)
    for number in range(min(options.clips, len(Store(options.data)))):
        file = Store(options.data)[number]
        start = len(file) - FRAMES
        memory = factory.empty(file.info)
        memory.write(file.read(range(start + 1)).observations)
        truth = file.read(range(start, start + FRAMES)).observations
        first = dataclasses.replace(truth, rgb=truth.rgb[:1], depth=truth.depth[:1])
        tokens = memory.read(truth.cameras, backbone.token_budget)
        clip = Clip(first, (None,) * (FRAMES - 1), seed=number, tokens=tokens)
        backbone.generate(Clips.stack([clip]), Sampling(4, sampler="unipc"))
    rows = []
    for key, figures in found.items():
        tokens_, spread, common, added = torch.tensor(figures).mean(0).tolist()
        rows.append((key, f"{tokens_:.0f}", f"{spread:.0f}", f"{100 * common:.1f} %", f"{100 * added:.1f} %"))
    print_table(str(options.checkpoint), COLUMNS, rows)


if __name__ == "__main__":
    main()
