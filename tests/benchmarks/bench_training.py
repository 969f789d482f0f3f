"""How fast the tiny model trains: ``python tests/benchmarks/bench_training.py``; prints a table, asserts nothing.

Each recipe's own training step on a fixed batch: loss, backward, clipping, optimizer, average. Beside it stands the
time of making the batch: reading the clips, and building their memories. The stages that can use a cache stand there a
second time, with all clips of the batch in it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator
from functools import partial
from itertools import repeat
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from accelerate import Accelerator

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_cli.api.backbone import Clips
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.output.console import print_table
from persist_cli.recipe import apply_overrides, make_recipe, read_recipe
from persist_cli.train.finetune import prepare_backbone
from persist_cli.train.tensor_cache import CacheSettings
from persist_cli.train.trainer import Trainer
from tests.benchmarks.timing import Times, alternate, say_conditions
from tests.support.room_views import MEMORIES, write_room_walks

BATCH, ROUNDS = 4, 4
FORMS = ("projected", "canvas")  # that of the recipes is cross
RECIPES = (
    {"codec": "tiny-codec", "1": "tiny-stage1"}
    | {f"2, {name}": f"tiny-stage2-{name}" for name in MEMORIES}
    | {f"2, voxel, {form}": f"tiny-stage2-voxel adapter.form={form}" for form in FORMS}
)
CACHED = {"1, cached": "tiny-stage1", "2, voxel, cached": "tiny-stage2-voxel"}


class FixedBatchTrainer(Trainer):
    """The training loop on one batch over and over."""

    def samples(self) -> list[Any]:
        """Read the first samples from the store."""
        return [self.dataset[number] for number in range(BATCH)]

    def loader(self) -> Generator[Clips, None, None]:
        """The same batch without end."""
        yield from repeat(self.to_batch(self.samples()))


def make_trainer(recipe_line: str, data: Path, cache: CacheSettings | None = None) -> FixedBatchTrainer:
    """The trainer of a recipe with untrained weights; with a cache, the clips of its batch are in it.

    Args:
        recipe_line: the recipe's name, followed by changes to it.
        data: the data set.
        cache: where latents and tokens are kept.
    """
    name, *changes = recipe_line.split()
    data_changes = [f"data.path={data}", f"data.clips_per_trajectory={0 if cache is None else 8}"]
    recipe = make_recipe(apply_overrides(read_recipe(name), [*data_changes, *changes]), name)
    factory = MemoryFactory.of(recipe.memory) if recipe.memory else None
    backbone = prepare_backbone(recipe, None, factory)
    trainer = FixedBatchTrainer(recipe, backbone, factory, Accelerator(cpu=True), cache)
    if cache is not None:
        trainer.to_batch(trainer.samples())
    return trainer


def measure(data: Path) -> tuple[Times, Times, Times]:
    """Times of a step, of reading its samples and of making a batch of them, for each recipe."""
    trainers = {stage: make_trainer(name, data) for stage, name in RECIPES.items()}
    cache = CacheSettings(data / "cache", 1)
    trainers |= {stage: make_trainer(name, data, cache) for stage, name in CACHED.items()}
    steps: dict[str, Callable[[], Any]] = {}
    batches: dict[str, Callable[[], Any]] = {}
    for stage, trainer in trainers.items():
        steps[stage] = partial(next, trainer.steps())
        batches[stage] = partial(trainer.to_batch, trainer.samples())
    reads = {stage: trainer.samples for stage, trainer in trainers.items()}
    return alternate(steps, ROUNDS), alternate(reads, ROUNDS), alternate(batches, ROUNDS)


if __name__ == "__main__":
    say_conditions(f"tiny model, 64×64, batches of {BATCH}")
    with TemporaryDirectory() as folder:
        steps, reads, batches = measure(write_room_walks(Path(folder), 64))
    rows = []
    for stage in RECIPES | CACHED:
        step, read, batch = (times.median(stage) / BATCH for times in (steps, reads, batches))
        ratios = [f"{steps.ratio(stage, reference):.2f}×" for reference in ("1", "2, voxel")]
        rows.append((stage, f"{1 / step:.1f}", *ratios, *(f"{1e3 * part:.1f}" for part in (step, read, batch))))
    columns = [
        "stage",
        "samples/s",
        "time to stage 1",
        "to voxel, cross",
        "step, ms a sample",
        "reading, ms",
        "batch and memory, ms",
    ]
    print_table("training on the CPU", columns, rows)
