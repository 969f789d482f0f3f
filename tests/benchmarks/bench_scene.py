"""The model of scenes: windows a second that a training step takes, and seconds that it takes to imagine one.

    .venv/bin/python tests/benchmarks/bench_scene.py
    .venv/bin/python tests/benchmarks/bench_scene.py --recipe tiny-scene --batch 8 --steps 4,10 --rounds 3

Weights are random, and windows are rooms of random walls: neither changes what a step costs.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_cli.api.scene_model import SceneModel, SceneSamples
from persist_cli.api.stages import SCENE_STAGES, Stage
from persist_cli.output.console import print_table
from persist_cli.plugins import make_scene_model
from persist_cli.recipe import make_recipe, read_recipe
from tests.benchmarks.timing import alternate, say_conditions
from tests.support.random_scenes import PALETTE, random_sample


def main() -> None:
    options = read_options()
    recipe = make_recipe(read_recipe(options.recipe), options.recipe)
    if recipe.scene is None:
        raise SystemExit(f"{options.recipe}: trains no model of scenes")
    model = make_scene_model(recipe.scene.name, recipe.scene.settings)
    form = replace(model.form, cells=replace(model.form.cells, palette=PALETTE))  # a part of the classes
    drawn = [random_sample(form, seed) for seed in range(min(4, options.batch))]
    batch = SceneSamples.stack([drawn[number % len(drawn)] for number in range(options.batch)])
    parameters = sum(parameter.numel() for parameter in model.parameters())
    say_conditions(f"{options.recipe}: {parameters:,} parameters, windows of {form.shape}, batches of {options.batch}")
    print_training(model, batch, options.rounds)
    print_sampling(model, SceneSamples.stack(drawn[:1]), options.steps, options.rounds)


def read_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recipe", default="houses-64-scene")
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--steps", default="10,20", type=lambda text: [int(part) for part in text.split(",")])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    return options


def print_training(model: SceneModel, batch: SceneSamples, rounds: int) -> None:
    """Windows a second of forward and backward pass, in float32 and in mixed precision."""
    kinds = [(stage, half) for stage in SCENE_STAGES for half in (False, True)]
    times = alternate({kind: partial(train, model, batch, *kind) for kind in kinds}, rounds)
    rows = [[stage, "bf16" if half else "no", f"{len(batch.given) / times.median((stage, half)):.1f}"]
            for stage, half in kinds]  # fmt: skip
    print_table("training", ("stage", "precision", "windows/s"), rows)


def train(model: SceneModel, batch: SceneSamples, stage: Stage, half: bool) -> None:
    """Take a training step without the optimizer's part."""
    model.trained_parameters(stage)
    with torch.autocast("cpu", torch.bfloat16, enabled=half):
        loss = model(batch, stage)["loss"]
    loss.backward()
    model.zero_grad(set_to_none=True)


def print_sampling(model: SceneModel, one: SceneSamples, steps: list[int], rounds: int) -> None:
    """Seconds of one window, for each number of steps."""
    model.eval()
    times = alternate({count: partial(model.sample, one, count) for count in steps}, rounds)
    rows = [[str(count), f"{times.median(count):.2f}"] for count in steps]
    print_table("imagining one window", ("steps", "seconds"), rows)


if __name__ == "__main__":
    main()
