"""The choices of each memory, made on validation houses: settings of memory and adapter, then of sampling.

``python -m persist_cli.reproduce.choose OUT --base runs/stage1 --data runs/houses --validation runs/validation`` trains
each memory a short time with each of a few settings and measures them on houses that are neither of the training nor of
the test split. It then measures the best of them with other steps, samplers and guidance. So no memory is compared by
choices that were made for another. It stops and goes on like ``make table1``: what is done is not done again, and
with another base, other data, steps or clips it refuses. With ``--steps 0`` nothing is trained: memories that are drawn
into the views are measured as their adapters begin, as those of the packaged model are.

``OUT/choices.json`` has what was chosen and every trial, ``choices.md`` the same as a table, and ``OUT/recipes`` has a
recipe for each memory with what was chosen. They are written anew after each figure, and say of which split the houses
are; houses of the test split are refused.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import yaml

from persist_cli.api.inference import Sampling
from persist_cli.data.store import Store
from persist_cli.errors import DataError, PersistError, hint
from persist_cli.evaluate.report.result_file import read_results
from persist_cli.io.files import read_json, write_json, write_text
from persist_cli.output.console import say
from persist_cli.recipe import EXTENDS, apply_overrides, make_recipe, read_recipe
from persist_cli.reproduce.commands import COLLECT, run_line, run_main
from persist_cli.reproduce.plan_file import base_json, keep_plan, places

CHOICES: Final = "choices.json"
RECIPE: Final = "houses-64-stage2-"  # begins the names of the recipes that are varied

METRICS: Final = {"psnr": "PSNR", "psnr-last": "last frame", "lpips-alex": "LPIPS"}
CRITERION: Final = "lpips-alex"  # lower is better; by PSNR the blurriest would be chosen


def cells(edge: float, axes: int, drawn: float, budget: int) -> tuple[str, ...]:
    """The settings of a map with cells of an edge in metres, drawn somewhat larger."""
    size = f"memory.settings.cell={[edge] * axes}"
    return size, f"adapter.token_size={drawn}", f"adapter.token_budget={budget}"


def images(side: int, drawn: float, budget: int) -> tuple[str, ...]:
    """The settings of snapshots of so many rows and columns of patches."""
    return f"memory.settings.grid={[side, side]}", f"adapter.token_size={drawn}", f"adapter.token_budget={budget}"


def frames(count: int, patch: int) -> tuple[str, ...]:
    """The settings of so many whole frames, cut into patches of so many latent pixels."""
    return f"memory.settings.count={count}", f"adapter.token_budget={count}", f"adapter.frame_patch={patch}"


WIDER: Final = ("adapter.head_width=192",)

DRAWN: Final = ("voxel", "map2d", "snapshots")  # into the views, and of use before any training
SMALL: Final = (  # learned parts of these, which only take time as long as nothing trains them
    "adapter.head_width=16", "adapter.head_layers=1", "adapter.attention_tokens=0",
)  # fmt: skip
UNTRAINED: Final = (  # one step that changes no weight
    "training.steps=1", "training.batch=1", "training.learning_rate=1e-12", "training.warmup=0", "training.cooldown=0",
    "training.ema=0",
)  # fmt: skip

# for each memory what is tried on top of its recipe: resolution, and the head where it has one
TRIALS: Final[dict[str, dict[str, tuple[str, ...]]]] = {
    "none": {"learned-tokens": ()},
    "voxel": {
        "6cm": cells(0.0625, 3, 0.09, 16384),
        "2cm": cells(0.02, 3, 0.03, 131072),
        "2cm-wider-head": cells(0.02, 3, 0.03, 131072) + WIDER,
    },
    "map2d": {
        "6cm": cells(0.0625, 2, 0.09, 16384),
        "2cm": cells(0.02, 2, 0.03, 131072),
        "6cm-wider-head": cells(0.0625, 2, 0.09, 16384) + WIDER,
    },
    "snapshots": {
        "32x32": images(32, 0.12, 16384),
        "64x64": images(64, 0.06, 131072),
        "64x64-wider-head": images(64, 0.06, 131072) + WIDER,
    },
    "views": {"4-frames": frames(4, 1), "16-frames": frames(16, 2)},
    "context": {"4-frames": frames(4, 1), "16-frames": frames(16, 2)},
}

FIRST: Final = Sampling(4, "unipc", 1.0)  # of the trials of settings
GUIDANCES: Final = (1.0, 1.5, 2.0)  # tried first, with the other settings of FIRST
STEPS: Final = ((4, "ddim"), (10, "unipc"), (10, "ddim"), (20, "unipc"))  # tried then, with the best guidance


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is trained and measured.

    Args:
        out: folder of everything.
        base: the stage-1 run or checkpoint that all stand on.
        data: folders of the training houses.
        validation: folders of the validation houses.
        memories: names of the memories.
        steps: optimizer steps of each trial; 0 for adapters as they begin.
        clips: most clips that a trial is measured on.
    """

    out: Path
    base: str
    data: tuple[Path, ...]
    validation: tuple[Path, ...]
    memories: tuple[str, ...] = tuple(TRIALS)
    steps: int = 400
    clips: int = 48


@dataclass(frozen=True)
class Trial:
    """One thing that was tried, with its figures.

    Args:
        name: name of the settings.
        overrides: settings on top of the memory's recipe.
        sampling: how clips were sampled.
        figures: mean of each column of ``METRICS``.
        clips: number of clips.
        houses: number of houses that they are of.
    """

    name: str
    overrides: tuple[str, ...]
    sampling: Sampling
    figures: dict[str, float | None]
    clips: int
    houses: int

    @property
    def cost(self) -> float:
        """What the choice is made by; infinite where it could not be measured."""
        value = self.figures[CRITERION]
        return float("inf") if value is None else value

    def __str__(self) -> str:
        return f"{self.name}, {self.sampling.words}"


def best_of(trials: Sequence[Trial]) -> Trial:
    """The trial of the lowest cost, of equal ones the first."""
    return min(trials, key=lambda trial: trial.cost)


def preparations(plan: Plan) -> list[str]:
    """The command lines that bring weights, and validation houses where the plan names none of its own."""
    home, lines = shlex.quote(str(plan.out)), ["weights fetch lpips-alex"]
    if plan.validation == default_validation(plan.out):
        split = "--frames 129 --split validation"
        lines += [
            f"{COLLECT} --out {home}/validation/path --scenes 0:16 --policy path {split}",
            f"{COLLECT} --out {home}/validation/explore --scenes 16:32 --policy explore {split}",
        ]
    return lines


def default_validation(out: Path) -> tuple[Path, ...]:
    """Where validation houses are collected to."""
    return out / "validation/path", out / "validation/explore"


def train_command(plan: Plan, memory: str, name: str) -> str:
    """The command line that trains a memory with the settings of a trial, on from where it stopped."""
    data = " ".join(f"--data {shlex.quote(str(folder))}" for folder in plan.data)
    if plan.steps:
        settings = [f"training.steps={plan.steps}", f"training.cooldown={plan.steps // 3}"]
    else:
        settings = [*UNTRAINED, *(SMALL if memory in DRAWN else ())]
    changes = shlex.join([f"base={plan.base}", *TRIALS[memory][name], *settings])
    cache = shlex.quote(str(plan.out / "cache"))
    run = shlex.quote(str(run_folder(plan, memory, name)))
    return f"finetune {RECIPE}{memory} {data} --out {run} --resume --cache {cache} {changes}"


def eval_command(plan: Plan, memory: str, name: str, sampling: Sampling) -> str:
    """The command line that measures a trial on the validation houses."""
    data = " ".join(f"--data {shlex.quote(str(folder))}" for folder in plan.validation)
    options = f"--memories {memory} --controls '' --metrics psnr,lpips-alex --frames 9 --seeds 1 --clips {plan.clips}"
    guidance = f"--guidance {sampling.memory_guidance:g} --autoguidance 1"
    sampled = f"--steps {sampling.steps} --sampler {sampling.sampler} {guidance}"
    run, out = (shlex.quote(str(folder)) for folder in (
        run_folder(plan, memory, name), result_folder(plan, memory, name, sampling)
    ))  # fmt: skip
    return f"eval {run} {data} {options} {sampled} --out {out}"


def run_folder(plan: Plan, memory: str, name: str) -> Path:
    """The folder of a trial's training."""
    return plan.out / "runs" / memory / name


def result_folder(plan: Plan, memory: str, name: str, sampling: Sampling) -> Path:
    """The folder of a trial's evaluation."""
    sampled = f"{sampling.sampler}-{sampling.steps}-guidance-{sampling.memory_guidance:g}"
    return plan.out / "eval" / memory / name / sampled


def measure(plan: Plan, memory: str, name: str, sampling: Sampling) -> Trial:
    """Train and measure a trial, unless that is done, and return its figures."""
    folder = result_folder(plan, memory, name, sampling)
    if not (folder / "metrics.json").is_file():
        run_line(train_command(plan, memory, name))
        run_line(eval_command(plan, memory, name, sampling))
    results = read_results(folder / "metrics.json")
    table = results.tables[0]
    columns = table.rows[memory].columns
    figures = {column: columns[column].mean if column in columns else None for column in METRICS}
    scenes = {results.measured.clips[number].scene for number in table.clips}
    return Trial(name, TRIALS[memory][name], sampling, figures, len(table.clips), len(scenes))


def trial_names(plan: Plan, memory: str) -> list[str]:
    """The names of the settings to try; a wider head that nothing trains is none."""
    return [name for name, settings in TRIALS[memory].items() if plan.steps or not {*WIDER} & {*settings}]


def trials_of(plan: Plan, memory: str) -> Iterator[list[Trial]]:
    """Yield the trials of a memory so far, after each one: settings first, then guidance, then steps and sampler."""
    trials: list[Trial] = []
    for name in trial_names(plan, memory):
        trials.append(measure(plan, memory, name, FIRST))
        yield trials
    for guidance in GUIDANCES[1:] if memory != "none" else ():  # of a memory that gives nothing it changes nothing
        trials.append(measure(plan, memory, best_of(trials).name, Sampling(FIRST.steps, FIRST.sampler, guidance)))
        yield trials
    chosen = best_of(trials)
    for steps, sampler in STEPS:
        trials.append(measure(plan, memory, chosen.name, Sampling(steps, sampler, chosen.sampling.memory_guidance)))
        yield trials


def splits_of(folders: Sequence[Path]) -> list[str]:
    """The splits that the houses of some folders are of; without those of houses that do not say it.

    Raises:
        DataError: when a house is of the test split, since figures on it would flatter what is chosen by it.
    """
    splits = {file.path: file.info.source.get("split") for folder in folders for file in Store(folder)}
    for path, split in splits.items():
        if split == "test":
            raise DataError(
                f"{path}: of the test split, by which nothing may be chosen; collect with --split validation"
            )
    return sorted({str(split) for split in splits.values() if split})


def houses_text(houses: int, splits: Sequence[str]) -> str:
    """So many houses and their splits in words, as in ``12 houses of the split validation``."""
    named = f"of the split{'s' * (len(splits) > 1)} {' and '.join(splits)}" if splits else "of unknown split"
    return f"{houses} houses {named}"


def choice_json(memory: str, trials: Sequence[Trial], splits: Sequence[str]) -> dict[str, Any]:
    """What was chosen for a memory, why, on houses of which splits, and every trial, as JSON values."""
    best = best_of(trials)
    others = [trial for trial in trials if trial is not best]
    reason = f"the only one that was measured, {CRITERION} {best.cost:.4f}"
    if others:
        second = best_of(others)
        reason = f"lowest {CRITERION} of {len(trials)}, {best.cost:.4f}; next is {second}: {second.cost:.4f}"
    return {
        "recipe": f"{RECIPE}{memory}",
        "name": best.name,
        "overrides": list(best.overrides),
        "sampling": asdict(best.sampling),
        "cost": best.figures[CRITERION],
        "chosen_on": houses_text(best.houses, splits),
        "reason": f"{reason} ({best.clips} clips of {houses_text(best.houses, splits)})",
        "trials": [asdict(trial) for trial in trials],
    }


def write_choices(plan: Plan, choices: Mapping[str, Any], splits: Sequence[str]) -> None:
    """Write what is chosen so far as JSON, as a table and as recipes."""
    described = {"base": plan.base, "steps": plan.steps, "by": CRITERION, "splits": [*splits]}
    folders = {"data": [*map(str, plan.data)], "validation": [*map(str, plan.validation)]}
    write_json(plan.out / CHOICES, described | folders | {"memories": dict(choices)})
    write_text(plan.out / "choices.md", table_text(choices))
    for memory, choice in choices.items():
        path = recipe_file(plan.out, memory)
        path.parent.mkdir(parents=True, exist_ok=True)
        values = apply_overrides({EXTENDS: choice["recipe"], "chosen_on": choice["chosen_on"]}, choice["overrides"])
        write_text(path, f"# chosen: {choice['reason']}\n{yaml.safe_dump(values, sort_keys=False)}")


def kept_choices(out: Path) -> dict[str, Any]:
    """What an earlier run chose for each memory, and its trials, as JSON values."""
    path = out / CHOICES
    return dict(read_json(path)["memories"]) if path.is_file() else {}


def finished_choices(out: Path) -> dict[str, Any]:
    """The same; ``PersistError`` when nothing was chosen yet."""
    if not (out / CHOICES).is_file():
        raise PersistError(f"{out / CHOICES}: not there yet; `python -m persist_cli.reproduce.choose {out}` makes it")
    return kept_choices(out)


def recipe_file(out: Path, memory: str) -> Path:
    """The recipe of a memory with what was chosen for it."""
    return out / "recipes" / f"{memory}.yaml"


def table_text(choices: Mapping[str, Any]) -> str:
    """Every trial as a Markdown table, those that were chosen in bold."""
    lines = ["| memory | settings | sampling | " + " | ".join(METRICS.values()) + " |", "|---|---|---|---:|---:|---:|"]
    for memory, choice in choices.items():
        for trial in choice["trials"]:
            chosen = (trial["name"], trial["sampling"]) == (choice["name"], choice["sampling"])
            figures = [trial["figures"][column] for column in METRICS]
            texts = ["n/a" if figure is None else f"{figure:.4g}" for figure in figures]
            cells = [memory, trial["name"], Sampling(**trial["sampling"]).words, *texts]
            lines.append("| " + " | ".join(f"**{cell}**" if chosen else cell for cell in cells) + " |")
    reasons = [f"- {memory}: {choice['reason']}" for memory, choice in choices.items()]
    return "\n".join([*lines, "", *reasons]) + "\n"


def chosen_sampling(out: Path) -> dict[str, Sampling]:
    """The sampling that was chosen for each memory.

    Raises:
        PersistError: when nothing was chosen yet.
    """
    return {memory: Sampling(**choice["sampling"]) for memory, choice in finished_choices(out).items()}


def chosen_costs(out: Path) -> dict[str, float]:
    """The cost of what was chosen for each memory; ``PersistError`` when nothing was chosen yet."""
    choices = finished_choices(out)
    return {memory: float("inf") if choice["cost"] is None else choice["cost"] for memory, choice in choices.items()}


def identity(plan: Plan) -> dict[str, Any]:
    """JSON values of all that changes a figure; memories may be added later."""
    return {
        "base": base_json(plan.base),
        "data": places(plan.data),
        "validation": places(plan.validation),
        "steps": plan.steps,
        "clips": plan.clips,
    }


def run_choose(plan: Plan) -> None:
    """Make the choices of every memory, one after the other.

    Raises:
        PersistError: when the folder holds figures of another plan, or a house is of the test split.
    """
    keep_plan(plan.out, identity(plan))
    for line in preparations(plan):
        run_line(line)
    splits = splits_of(plan.validation)
    choices = kept_choices(plan.out)
    for memory in plan.memories:
        for trials in trials_of(plan, memory):
            if memory not in choices or len(trials) >= len(choices[memory]["trials"]):  # else it is read again only
                choices[memory] = choice_json(memory, trials, splits)
                write_choices(plan, choices, splits)
    say(f"\n{table_text(choices)}")


def memories_of(text: str, steps: int) -> tuple[str, ...]:
    """The memories named in a list separated by commas.

    Raises:
        PersistError: when there is nothing to choose for one, or in ``steps`` of 0 it could be of no use.
    """
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",")))
    for name in names:
        if name not in TRIALS:
            raise PersistError(f"no choices for memory {name!r}; {hint(name, list(TRIALS))}")
        if not steps and name not in ("none", *DRAWN):
            raise PersistError(f"memory {name!r} is of no use before it is trained; take it out, or give --steps 400")
    return names


def main(arguments: Sequence[str]) -> None:
    """Make the choices of some memories, and end with the exit code of a command that fails.

    Raises:
        PersistError: when there is no such memory, or what ``run_choose`` raises.
    """
    parser = argparse.ArgumentParser(prog="python -m persist_cli.reproduce.choose")
    parser.add_argument("out", type=Path, help="folder of everything")
    parser.add_argument("--base", default="reference", help="stage-1 run or checkpoint that all stand on")
    parser.add_argument("--data", action="append", type=Path, required=True, help="training houses; may be repeated")
    parser.add_argument("--validation", action="append", type=Path, help="validation houses; collected by default")
    parser.add_argument("--memories", default=",".join(TRIALS), help="separated by commas")
    parser.add_argument("--steps", type=int, default=Plan.steps, help="optimizer steps of a trial; 0 for none")
    parser.add_argument("--clips", type=int, default=Plan.clips, help="most clips of an evaluation")
    options = parser.parse_args(arguments)
    validation = tuple(options.validation or default_validation(options.out))
    memories = memories_of(options.memories, options.steps)
    for memory in memories:
        make_recipe(read_recipe(f"{RECIPE}{memory}"), f"{RECIPE}{memory}")
    plan = Plan(
        out=options.out, base=options.base, data=tuple(options.data), validation=validation, memories=memories,
        steps=options.steps, clips=options.clips,
    )  # fmt: skip
    run_choose(plan)


if __name__ == "__main__":
    run_main(main)
