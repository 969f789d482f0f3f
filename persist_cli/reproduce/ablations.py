"""``make ablations``: the paper's memory at small size and what becomes of it when one part is changed.

``python -m persist_cli.reproduce.ablations [OUT] --samples 1000,5000`` trains every recipe whose name begins with
``houses-64-paper`` on one frozen base to 1,000 samples, measures each against the base on validation houses, then
trains all of them on to 5,000 samples, and so forth. So it draws a curve of gain against samples for each. It stops
and goes on like ``make table1``: what is done is not done again, and a longer list of samples continues. ``OUT`` keeps
to one base, data, clips and seed: with others it refuses.

``OUT/ablations.json`` has all figures, ``ablations.md`` the table and ``gain.png`` the curves; they are written anew
after each figure.
"""

from __future__ import annotations

import argparse
import math
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from persist_cli.api.checkpoint import step_folders
from persist_cli.errors import PersistError, hint
from persist_cli.evaluate.report.result_file import Cell, read_results
from persist_cli.io.files import write_json, written_aside
from persist_cli.io.hub import cached_weight
from persist_cli.output.console import say
from persist_cli.output.curve import Curve, draw_curves
from persist_cli.recipe import Recipe, apply_overrides, make_recipe, read_recipe, recipe_names
from persist_cli.reproduce.commands import COLLECT, run_line, run_main
from persist_cli.reproduce.plan_file import base_json, keep_plan, places

PREFIX: Final = "houses-64-paper"
HOUSES: Final = 400  # collected for training when no data are named; a quarter of them are explored
FETCHED: Final = ("dinov2-s-derived", "lpips-alex")  # weights that are brought first
SAMPLING: Final = "--steps 4 --sampler unipc --guidance 1"  # without guidance, so that gain is the memory's alone
BASELINE: Final = "stage1"  # the row that gain is measured against: the base without an adapter
CONTROL: Final = "shuffled"  # the adapter with another house's memory: what more training gives without remembering
METRICS: Final = {"psnr": "PSNR", "psnr-last": "last frame", "lpips-alex": "LPIPS"}


Gain = tuple[float | None, float | None, float | None]  # mean, low and high
Gains = dict[str, Gain]  # by column


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is trained and measured.

    Args:
        out: folder of everything.
        samples: numbers of training samples after which each recipe is measured, ascending.
        recipes: names of the recipes.
        base: the stage-1 run or checkpoint that all stand on.
        data: folders of the training houses.
        held_out: folders of the houses that gain is measured on.
        clips: most clips that gain is measured on.
        seed: seed of the trainings.
        settings: further settings of all trainings, ``KEY=VALUE``.
    """

    out: Path
    samples: tuple[int, ...]
    recipes: tuple[str, ...]
    base: str
    data: tuple[Path, ...]
    held_out: tuple[Path, ...]
    clips: int = 48
    seed: int = 0
    settings: tuple[str, ...] = ()

    def all_recipes(self) -> dict[str, Recipe]:
        """The recipes by name, with the further settings."""
        return {name: self.recipe(name) for name in self.recipes}

    def recipe(self, name: str) -> Recipe:
        """A recipe with the further settings, which all trials of a folder have."""
        return make_recipe(apply_overrides(read_recipe(name), self.settings), name)


@dataclass(frozen=True)
class Point:
    """The gain of one recipe after some training samples.

    Args:
        recipe: name of the recipe.
        description: its description.
        samples: number of training samples.
        steps: number of optimizer steps.
        gain: difference to the base by column, as mean, low and high of its 95 % interval.
        remembered: difference to the same adapter with another house's memory, likewise.
        value: the figure itself by column.
        base: the base's figure by column.
        clips: number of clips.
        houses: number of houses that they are of.
    """

    recipe: str
    description: str
    samples: int
    steps: int
    gain: Gains
    remembered: Gains
    value: dict[str, float | None]
    base: dict[str, float | None]
    clips: int
    houses: int


def ablation_names() -> tuple[str, ...]:
    """The names of the paper's recipe and of its ablations, the former first."""
    return tuple(name for name in recipe_names() if name.startswith(PREFIX))


def chosen_recipes(names: Sequence[str]) -> tuple[str, ...]:
    """The recipes of these names, which may be given without ``PREFIX``; all recipes without names.

    Raises:
        PersistError: when one is unknown.
    """
    known = ablation_names()
    short = {name.removeprefix(f"{PREFIX}-"): name for name in known} | {"paper": PREFIX}
    chosen = [short.get(name, name) for name in names]
    for name in chosen:
        if name not in known:
            raise PersistError(f"no ablation {name!r}; {hint(name, short)}")
    return tuple(chosen) or known


def missing_weights(recipe: Recipe) -> str | None:
    """The name of weights that the recipe's encoder needs and that are not here."""
    weights = None if recipe.memory is None else recipe.memory.encoder_settings.get("weights")
    return weights if weights is not None and cached_weight(weights) is None else None


def preparations(plan: Plan, houses: int) -> list[str]:
    """The command lines that bring weights, and houses where the plan names none of its own."""
    explored, home = max(1, houses // 4), shlex.quote(str(plan.out))
    first = max(1600, houses - explored)  # of the explored ones, which are others than those of the paths
    lines = [f"weights fetch {' '.join(FETCHED)}"]
    if plan.data == default_data(plan.out):
        lines += [
            f"{COLLECT} --out {home}/houses/path --scenes 0:{houses - explored} --frames 100 --policy path",
            f"{COLLECT} --out {home}/houses/explore --scenes {first}:{first + explored} --frames 100 --policy explore",
        ]
    if plan.held_out == default_held_out(plan.out):
        lines += [
            f"{COLLECT} --out {home}/held-out/path --scenes 0:12 --frames 129 --policy path --split validation",
            f"{COLLECT} --out {home}/held-out/explore --scenes 50:62 --frames 129 --policy explore --split validation",
        ]
    return lines


def default_data(out: Path) -> tuple[Path, ...]:
    """Where training houses are collected to."""
    return out / "houses/path", out / "houses/explore"


def default_held_out(out: Path) -> tuple[Path, ...]:
    """Where validation houses are collected to."""
    return out / "held-out/path", out / "held-out/explore"


def steps_of(recipe: Recipe, samples: int) -> int:
    """The optimizer steps in which a recipe sees so many samples, or a part of a batch more."""
    return math.ceil(samples / recipe.training.batch)


def train_command(plan: Plan, name: str, steps: int) -> str:
    """The command line that trains a recipe up to a step, on from where it stopped.

    The learning rate is constant after 20 steps, so that a longer training begins like a shorter one.
    """
    home, data = shlex.quote(str(plan.out)), " ".join(f"--data {shlex.quote(str(folder))}" for folder in plan.data)
    settings = f"base={shlex.quote(plan.base)} training.steps={steps} training.cooldown=0 training.warmup=20"
    settings = " ".join([settings, f"training.seed={plan.seed}", *map(shlex.quote, plan.settings)])
    return f"finetune {name} {data} --out {home}/{name} --resume --cache {home}/cache {settings}"


def eval_command(plan: Plan, name: str, memory: str, samples: int, checkpoint: Path) -> str:
    """The command line that measures a checkpoint and its base on the held-out houses."""
    data = " ".join(f"--data {shlex.quote(str(folder))}" for folder in plan.held_out)
    options = f"--memories {BASELINE},{memory} --controls {CONTROL} --metrics psnr,lpips-alex --frames 9 --seeds 1"
    out = shlex.quote(str(result_folder(plan, name, samples)))
    return f"eval {shlex.quote(str(checkpoint))} {data} {options} --clips {plan.clips} {SAMPLING} --out {out}"


def result_folder(plan: Plan, name: str, samples: int) -> Path:
    """The folder of a recipe's evaluation after so many samples."""
    return plan.out / "eval" / f"{name}-{samples}"


def checkpoint_at(run: Path, steps: int, samples: int) -> Path:
    """The run's checkpoint of that step.

    Raises:
        PersistError: when the run has none, since it was trained further before.
    """
    found = [folder for folder in step_folders(run) if int(folder.name.rpartition("-")[2]) == steps]
    if not found:
        raise PersistError(
            f"{run}: no checkpoint of step {steps} ({samples} samples), the run is beyond it; leave {samples} out of "
            "--samples, or name another OUT"
        )
    return found[0] / "model"


def read_point(plan: Plan, name: str, recipe: Recipe, samples: int) -> Point:
    """The gain that an evaluation found.

    Raises:
        DataError: when the evaluation is not there, or damaged.
    """
    results = read_results(result_folder(plan, name, samples) / "metrics.json")
    table = results.tables[0]
    memory = recipe.memory.name if recipe.memory else BASELINE
    base, row = table.rows[BASELINE].columns, table.rows[memory].columns
    columns = [column for column in METRICS if column in row]
    scenes = {results.measured.clips[number].scene for number in table.clips}
    return Point(
        recipe=name,
        description=recipe.description,
        samples=samples,
        steps=steps_of(recipe, samples),
        gain={column: _gain(row[column], BASELINE) for column in columns},
        remembered={column: _gain(row[column], f"{memory}, {CONTROL}") for column in columns},
        value={column: row[column].mean for column in columns},
        base={column: base[column].mean for column in columns},
        clips=len(table.clips),
        houses=len(scenes),
    )


def _gain(cell: Cell, other: str) -> Gain:
    """A row's difference to another one."""
    gap = cell.differences.get(other)
    return (None, None, None) if gap is None else (gap.mean, gap.low, gap.high)


def points_of(plan: Plan) -> Iterator[Point]:
    """The gains that are measured so far, in earlier runs too: recipe by recipe, those of this plan first."""
    found: dict[str, list[int]] = {name: [] for name in plan.recipes}
    for file in sorted(plan.out.glob("eval/*/metrics.json")):
        name, _, number = file.parent.name.rpartition("-")
        found.setdefault(name, []).append(int(number))
    for name in found:
        for samples in sorted(found[name]):
            yield read_point(plan, name, plan.recipe(name), samples)


def write_results(plan: Plan, left_out: dict[str, str]) -> None:
    """Write the figures so far as JSON, their table and their curves."""
    points = list(points_of(plan))
    values = {
        "base": plan.base, "seed": plan.seed, "data": [*map(str, plan.data)], "held_out": [*map(str, plan.held_out)],
        "sampling": SAMPLING, "left_out": left_out, "points": [asdict(point) for point in points],
    }  # fmt: skip
    write_json(plan.out / "ablations.json", values)
    with written_aside(plan.out / "ablations.md") as aside:
        aside.write_text(table_text(points, left_out), encoding="utf-8")
    curves = [
        Curve(name, [(point.samples, *point.gain["psnr"]) for point in points if point.recipe == name])
        for name in dict.fromkeys(point.recipe for point in points)
    ]
    if curves:
        draw_curves(curves, "training samples", "PSNR − base, dB", plan.out / "gain.png")


def table_text(points: Sequence[Point], left_out: dict[str, str]) -> str:
    """The gains as a Markdown table, of each recipe after each number of samples."""
    titles = [*(f"{title} − base" for title in METRICS.values()), "PSNR − another house's memory"]
    lines = [f"| recipe | samples | {' | '.join(titles)} |", "|---|---|" + "---|" * len(titles)]
    for point in points:
        gains = [point.gain.get(column) for column in METRICS] + [point.remembered.get("psnr")]
        cells = ["n/a" if gain is None else _gain_text(*gain) for gain in gains]
        lines.append(f"| {point.recipe} | {point.samples:,} | {' | '.join(cells)} |")
    lines += [f"| {name} | | not trained: {reason} |" + " |" * (len(titles) - 1) for name, reason in left_out.items()]
    if points:
        houses, clips = points[-1].houses, points[-1].clips
        lines += ["", f"{clips} clips of {houses} held-out houses, 95 % intervals over houses, one training seed."]
    return "\n".join(lines) + "\n"


def _gain_text(mean: float | None, low: float | None, high: float | None) -> str:
    if mean is None:
        return "n/a"
    return f"{mean:+.3f}" if low is None or high is None else f"{mean:+.3f} [{low:+.3f}, {high:+.3f}]"


def identity(plan: Plan, houses: int) -> dict[str, Any]:
    """JSON values of all that changes a figure; recipes and numbers of samples may be added later."""
    return {
        "base": base_json(plan.base),
        "data": places(plan.data),
        "houses": houses if plan.data == default_data(plan.out) else None,
        "held_out": places(plan.held_out),
        "clips": plan.clips,
        "seed": plan.seed,
        "sampling": SAMPLING,
    } | ({"settings": [*plan.settings]} if plan.settings else {})


def run_ablations(plan: Plan, houses: int = HOUSES) -> None:
    """Train and measure what is not measured yet, all recipes to one number of samples before any goes on.

    Raises:
        PersistError: when the folder holds figures of another plan, or a checkpoint of an earlier number of samples is
            gone.
    """
    keep_plan(plan.out, identity(plan, houses))
    for line in preparations(plan, houses):
        run_line(line)
    recipes = plan.all_recipes()
    missing = {name: weights for name, recipe in recipes.items() if (weights := missing_weights(recipe))}
    left_out = {name: f"persist weights fetch {weights}" for name, weights in missing.items()}
    for name, reason in left_out.items():
        say(f"{name}: left out, its weights are not here: {reason}")
    for samples in plan.samples:
        for name, recipe in recipes.items():
            if name not in left_out and not (result_folder(plan, name, samples) / "metrics.json").is_file():
                steps = steps_of(recipe, samples)
                run_line(train_command(plan, name, steps))
                checkpoint = checkpoint_at(plan.out / name, steps, samples)
                memory = recipe.memory.name if recipe.memory else BASELINE
                run_line(eval_command(plan, name, memory, samples, checkpoint))
            write_results(plan, left_out)
    say(f"\n{table_text(list(points_of(plan)), left_out)}")


def numbers(text: str) -> tuple[int, ...]:
    """Ascending positive numbers out of a list separated by commas."""
    found = tuple(sorted({int(part) for part in text.split(",")}))
    if found[0] < 1:
        raise ValueError(text)
    return found


def main(arguments: Sequence[str]) -> None:
    """Run the ablations.

    Raises:
        PersistError: when there is no such ablation or base, or what ``run_ablations`` raises.
    """
    parser = argparse.ArgumentParser(prog="python -m persist_cli.reproduce.ablations", description=__doc__)
    parser.add_argument("out", nargs="?", type=Path, default=Path("runs/ablations"), help="folder of everything")
    parser.add_argument("--samples", type=numbers, default=(4800,), help="training samples, as in 1000,5000,50000")
    parser.add_argument("--only", default="", help="some of the ablations, as in paper,tokens-64,key-camera")
    parser.add_argument("--base", default="reference", help="stage-1 run or checkpoint; else that of the package")
    parser.add_argument("--data", type=Path, action="append", help="training houses; else collected")
    parser.add_argument("--held-out", type=Path, action="append", help="houses to measure on; else collected")
    parser.add_argument("--houses", type=int, default=HOUSES, help="houses to collect for training")
    parser.add_argument("--clips", type=int, default=48, help="most clips to measure on")
    parser.add_argument("--seed", type=int, default=0, help="seed of the trainings")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="of all trainings, as in training.precision=no"
    )
    options = parser.parse_args(arguments)
    recipes = chosen_recipes([name for name in options.only.split(",") if name])
    data, held_out = options.data or default_data(options.out), options.held_out or default_held_out(options.out)
    plan = Plan(
        out=options.out, samples=options.samples, recipes=recipes, base=options.base, data=tuple(data),
        held_out=tuple(held_out), clips=options.clips, seed=options.seed, settings=tuple(options.set),
    )  # fmt: skip
    run_ablations(plan, options.houses)


if __name__ == "__main__":
    run_main(main)
