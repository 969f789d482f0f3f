"""``make table1``: the reference model from nothing to its tables, by the commands that a user would type.

``python -m persist_cli.reproduce.table1 [OUT]`` runs them in order, each in a process of its own; with ``--reference``
it trains nothing and measures the model that comes with the package, as its card says. Every command continues where it
was stopped and repeats nothing that is done, so this may be stopped and started at any time. With ``--trial`` each
command runs in its smallest form, to see in about an hour that all of them work here; its figures are worth nothing.

Houses for training, validation and test share no scene. Cells, head and sampling are chosen for each memory by itself
on validation houses, by ``persist_cli.reproduce.choose``, before any of the tables is measured.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from persist_cli.api.inference import Sampling
from persist_cli.reproduce import choose
from persist_cli.reproduce.commands import COLLECT, run_line, run_main
from persist_cli.reproduce.trial import CLIPS, STEPS, run_small, trial_folder

PACKAGED = ("none", "voxel", "map2d", "snapshots")  # memories of the model that comes with the package
CHOSEN = (*PACKAGED, "views", "context")  # memories for which choices are made; the first is the baseline
FIXED = ("nwm",)  # memories as their recipes are: of the paper's NWM nothing is to be chosen
FORMS = ("cross", "projected", "canvas", "canvas-head", "rendered")  # the same map, another way to the video
EQUAL = ("voxel", "map2d", "snapshots", "views", "context")  # memories of equal information
WITHOUT_DEPTH = ("none", "context", "views", "voxel")  # on a model that never saw depth; voxel reads it all the same
SEEDS = 3  # trainings of none, voxel and the best other

COMMON = "--steps 4 --sampler unipc --guidance 1"  # where nothing was chosen, or for another recipe than those compared
INVENTING = "--steps 20 --sampler ddim --guidance 1"  # few steps blur what is invented, which raises PSNR and SRC
METRICS = "psnr,sharpness,grain,ssim,lpips-alex,fvd,absrel,delta1"
RGB_METRICS = "psnr,sharpness,grain,ssim,lpips-alex,fvd"  # of models without depth
WEIGHTS = ("lpips-alex", "lpips-vgg", "i3d-kinetics-400", "dinov2-s-derived")  # of every metric that can be fetched


@dataclass(frozen=True)
class Chosen:
    """What ``choose`` found on validation houses.

    Args:
        sampling: sampling of each memory.
        other: the best memory but none and voxel.
    """

    sampling: Mapping[str, Sampling] = field(default_factory=dict)
    other: str = "snapshots"

    @staticmethod
    def of(out: Path) -> Chosen:
        """Read the choices.

        Raises:
            PersistError: when there are none yet.
        """
        costs = {name: cost for name, cost in choose.chosen_costs(out).items() if name not in CHOSEN[:2]}
        return Chosen(choose.chosen_sampling(out), min(costs, key=lambda name: costs[name]))


def commands(out: Path, chosen: Chosen = Chosen()) -> list[str]:
    """All command lines in order; weights come first, so that nothing is missing after days of training."""
    return [*base_commands(out), *memory_commands(out, chosen), *evaluate_commands(out, chosen)]


def base_commands(out: Path) -> list[str]:
    """The command lines before the choices: weights, houses, codec, and the video models with and without depth."""
    home, data = shlex.quote(str(out)), training_data(out)
    cached = f"{data} --cache {home}/cache"
    return [
        fetch_command(),
        *collect_commands(out),
        f"finetune houses-64-codec {data} --out {home}/codec",
        f"finetune houses-64-stage1 {cached} --out {home}/stage1 base={home}/codec",
        f"finetune houses-64-stage1-rgb {cached} --out {home}/stage1-rgb base={home}/codec",
    ]


def choice_plan(out: Path) -> choose.Plan:
    """The choices that are made between the video model and the memories."""
    data = tuple(out / "houses" / policy for policy in POLICIES)
    validation = tuple(out / "validation" / policy for policy in HELD_OUT)
    return choose.Plan(out=out / "choices", base=str(out / "stage1"), data=data, validation=validation, memories=CHOSEN)


def reference_commands(out: Path) -> list[str]:
    """The command lines that measure the packaged model: the tables of its card."""
    return [fetch_command(), *collect_held_out(out, "test"), *packaged_commands(out)]


def fetch_command() -> str:
    """The command line that brings the weights of every metric."""
    return f"weights fetch {' '.join(WEIGHTS)}"


POLICIES: Mapping[str, str] = {  # by policy the scenes of each split
    "path": "0:1600", "explore": "4000:5400",
}  # fmt: skip
HELD_OUT: Mapping[str, str] = {"path": "0:40", "explore": "40:70", "loop": "70:100"}


def collect_commands(out: Path) -> list[str]:
    """The command lines that collect 3,000 training houses of 100 frames, and the held-out ones."""
    home = shlex.quote(str(out))
    train = [
        f"{COLLECT} --out {home}/houses/{policy} --scenes {scenes} --frames 100 --policy {policy}"
        for policy, scenes in POLICIES.items()
    ]
    return [*train, *collect_held_out(out, "validation"), *collect_held_out(out, "test")]


def collect_held_out(out: Path, split: str) -> list[str]:
    """The command lines that collect 100 houses of 129 frames of a split, and loops through all of the test split."""
    home = shlex.quote(str(out))
    lines = [
        f"{COLLECT} --out {home}/{split}/{policy} --scenes {scenes} --frames 129 --policy {policy} --split {split}"
        for policy, scenes in HELD_OUT.items()
    ]
    if split != "test":
        return lines
    loop = f"--scenes 0:100 --frames 129 --policy loop --split {split}"
    return [*lines, f"{COLLECT} --out {home}/loop {loop}"]


def training_data(out: Path) -> str:
    """The options of a training on all training houses that goes on where it was stopped."""
    home = shlex.quote(str(out))
    return " ".join([*(f"--data {home}/houses/{policy}" for policy in POLICIES), "--resume"])


def memory_commands(out: Path, chosen: Chosen = Chosen()) -> list[str]:
    """The command lines that train adapters: of each memory, of equal information, of other forms, without depth."""
    home = shlex.quote(str(out))
    stage2 = f"{training_data(out)} --cache {home}/cache base={home}/stage1"
    without_depth = f"{training_data(out)} --cache {home}/cache base={home}/stage1-rgb"
    recipes = {memory: shlex.quote(str(choose.recipe_file(out / "choices", memory))) for memory in CHOSEN}
    seeded = [(memory, seed) for memory in (*CHOSEN[:2], chosen.other) for seed in range(SEEDS)]
    return [
        *(f"finetune {recipes[memory]} {stage2} --out {home}/{memory}" for memory in CHOSEN),
        *(f"finetune houses-64-stage2-{memory} {stage2} --out {home}/{memory}" for memory in FIXED),
        *(f"finetune houses-64-equal-{memory} {stage2} --out {home}/equal-{memory}" for memory in EQUAL),
        *(f"finetune houses-64-forms-{form} {stage2} --out {home}/forms-{form}" for form in FORMS),
        *(f"finetune houses-64-stage2-{name}-rgb {without_depth} --out {home}/{name}-rgb" for name in WITHOUT_DEPTH),
        *(
            f"finetune {recipes[memory]} {stage2} --out {home}/seeds/{memory}-{seed} training.seed={seed}"
            for memory, seed in seeded
        ),
    ]


def evaluate_commands(out: Path, chosen: Chosen = Chosen()) -> list[str]:
    """The command lines of all tables of the runs in ``out``.

    Each memory is sampled as was chosen for it. In the tables of equal information, of forms and without depth all
    rows are sampled alike: what was chosen was chosen for the winner's recipe, which would have the advantage, and on a
    model with depth.
    """
    home, runs = shlex.quote(str(out)), tables(out, chosen)
    revisit = f"{revisit_options(out)} --clips 200"
    equal = [f"{home}/equal-{memory}" for memory in EQUAL]
    forms = [f"{home}/forms-{form}" for form in FORMS]
    without_depth = [f"{home}/{name}-rgb" for name in WITHOUT_DEPTH]
    seeded = (*CHOSEN[:2], chosen.other)
    seeds = [f"{home}/seeds/{memory}-{seed}" for memory in seeded for seed in range(SEEDS)]
    return [
        *runs,
        table(out, "equal", equal, f"{alike(EQUAL)} {revisit} --controls codec --metrics {METRICS}"),
        table(out, "forms", forms, f"{alike(('voxel',))} {revisit} --controls codec --metrics {METRICS}"),
        table(
            out, "without-depth", without_depth,
            f"{alike(WITHOUT_DEPTH)} {revisit} --controls codec --metrics {RGB_METRICS}",
        ),
        table(
            out, "seeds", seeds,
            f"{named(seeded, chosen)} {revisit} --controls codec --metrics {METRICS} --seeds 1 --training-seeds",
        ),
    ]  # fmt: skip


def packaged_commands(out: Path) -> list[str]:
    """The command lines of the tables of the packaged model's card, sampled as it asks for itself.

    They have fewer clips and one sampling seed, so that two cores measure them in about an hour.
    """
    memories, loops = ",".join(PACKAGED), f"--data {shlex.quote(str(out))}/loop"
    revisit = f"{revisit_options(out)} --seeds 1"
    return [
        table(out, "revisit", [], f"--memories {memories} {revisit} --clips 48 --controls copy,nearest,warp,codec"),
        table(out, "disturbed", [], f"--memories voxel {revisit} --clips 24 --controls warp,noisy,drifting"),
        table(
            out, "return", [],
            f"--memories none,voxel {loops} --protocol return --frames 129 --clips 8 --seeds 1 --controls copy,codec",
        ),
    ]  # fmt: skip


def tables(out: Path, chosen: Chosen) -> list[str]:
    """The command lines of the tables of all memories: revisits, disturbed memories, returns and long rollouts.

    The first memory is the baseline, the second the one that is disturbed.
    """
    home, pair, returns = shlex.quote(str(out)), CHOSEN[:2], f"--data {shlex.quote(str(out))}/loop"
    revisit = f"{revisit_options(out)} --clips 200"

    def rows(names: Sequence[str]) -> list[str]:
        return [f"{home}/{name}" for name in names]

    def inventing(names: Sequence[str]) -> str:
        return f"--memories {','.join(names)} {INVENTING}"

    disturbed = f"--controls shuffled,emptied,oracle,noisy,drifting --metrics {METRICS}"
    return [
        table(
            out, "revisit", rows([*CHOSEN, *FIXED]),
            f"{named(CHOSEN, chosen)} {revisit} --controls copy,nearest,warp,codec",
        ),
        table(out, "disturbed", rows(pair), f"{named(pair, chosen)} {revisit} {disturbed}"),
        table(out, "return", rows(CHOSEN), f"{inventing(CHOSEN)} {returns} --protocol return --clips 32"),
        table(
            out, "long", rows(pair), f"{inventing(pair)} {returns} --protocol long --clips 16 --metrics {METRICS}"
        ),
    ]  # fmt: skip


def revisit_options(out: Path) -> str:
    """The options of a table of revisits to places of the test houses."""
    home = shlex.quote(str(out))
    data = " ".join(f"--data {home}/test/{policy}" for policy in HELD_OUT)
    return f"{data} --protocol revisit --frames 17"


def named(memories: Sequence[str], chosen: Chosen) -> str:
    """The options of some memories, each sampled as was chosen for it."""
    own = [
        f"--sampling-of {memory}:steps={sampling.steps},sampler={sampling.sampler},"
        f"guidance={sampling.memory_guidance:g}"
        for memory in memories
        if (sampling := chosen.sampling.get(memory)) is not None
    ]
    return " ".join([alike(memories), *own])


def alike(memories: Sequence[str]) -> str:
    """The options of some memories that are sampled alike, by no choice of any of them."""
    return f"--memories {','.join(memories)} {COMMON}"


def table(out: Path, name: str, checkpoints: Sequence[str], options: str) -> str:
    """The command line of a table with its report."""
    home = shlex.quote(str(out))
    return " ".join(["eval", *checkpoints, options, f"--out {home}/eval-{name} --report {home}/report-{name}"])


def main(arguments: Sequence[str]) -> None:
    """Run every command until one fails, and end with its exit code; ``PersistError`` where a choice cannot be made."""
    parser = argparse.ArgumentParser(prog="python -m persist_cli.reproduce.table1")
    parser.add_argument("out", nargs="?", type=Path, default=Path("runs/table1"), help="folder of everything")
    parser.add_argument("--reference", action="store_true", help="measure the model of the package, train none")
    parser.add_argument("--trial", action="store_true", help="every command in its smallest form, in OUT/trial")
    options = parser.parse_args(arguments)
    out, run = (trial_folder(options.out), run_small) if options.trial else (options.out, run_line)
    for line in reference_commands(out) if options.reference else base_commands(out):
        run(line)
    if options.reference:
        return
    plan = choice_plan(out)
    choose.run_choose(replace(plan, steps=STEPS, clips=CLIPS) if options.trial else plan)
    chosen = Chosen.of(out / "choices")
    for line in [*memory_commands(out, chosen), *evaluate_commands(out, chosen)]:
        run(line)


if __name__ == "__main__":
    run_main(main)
