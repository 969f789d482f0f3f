"""What a token of the paper's form is made of: ``python tests/benchmarks/bench_paper_tokens.py [--data DATA]``.

Prints a table, asserts nothing: how much of the features all cells have in common, with and without max pooling, and
how much of what differs between two tokens is their position, with and without normalised features.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch.nn.functional as F
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_backbones.adapters.memory_block import position_code
from persist_cli.api.cameras import invert_rigid
from persist_cli.api.geometry import transform
from persist_cli.data.reference import parse_reference
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.output.console import print_table
from persist_cli.recipe import make_recipe, read_recipe

FRAMES, CLIP, FREQUENCIES, ALL = 48, 9, 10, 100_000


def common(features: Tensor) -> float:
    """The share of the rows' energy that is that of their mean."""
    return float(features.mean(0).square().sum() / features.square().sum(1).mean())


def differing(rows: Tensor) -> float:
    """The mean energy of the rows' differences from their mean."""
    return float((rows - rows.mean(0)).square().sum(1).mean())


def main() -> None:
    """Measure the tokens of one trajectory and print one table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", default="sample#0", help="a trajectory, as in DATA#0")
    file = parse_reference(parser.parse_args().data).single()
    recipe = make_recipe(read_recipe("houses-64-paper"), "memory")
    assert recipe.memory is not None
    factory = MemoryFactory.of(recipe.memory)
    memory, written = factory.empty(file.info), file.read(slice(0, FRAMES)).observations
    memory.write(written)
    cameras = file.read(slice(FRAMES, FRAMES + CLIP)).observations.cameras
    tokens = memory.read(cameras, ALL)
    first_from_world = invert_rigid(cameras.world_from_camera[0].double())
    position = differing(position_code(transform(first_from_world, tokens.positions), FREQUENCIES))
    features = differing(tokens.features)
    normalized = differing(F.layer_norm(tokens.features, tokens.features.shape[-1:]))
    shares = [
        ("common to all patches", common(factory.encoder.encode(written.rgb).flatten(0, 2))),
        (f"common to all {len(tokens)} cells in view", common(tokens.features)),
        ("position, of what differs between tokens", position / (position + features)),
        ("the same, features normalised", position / (position + normalized)),
    ]
    rows = [(name, f"{100 * share:.1f} %") for name, share in shares]
    print_table("share of a token's energy", ["what", "share"], rows)


if __name__ == "__main__":
    main()
