"""``persist doctor``: what a training needs on a machine, and the smallest change that makes it fit."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from persist_cli.data.clips import check_batch_division
from persist_cli.doctor.changes import OFFLOADED, SHARDED, STAGE2, Strategy, changes_of, smallest
from persist_cli.doctor.dry_run import dry_run
from persist_cli.doctor.machine import Machine, gib
from persist_cli.doctor.memory_estimate import Estimator, Launch, MemoryEstimate
from persist_cli.doctor.meta_model import MetaModel, build_meta_model, build_stage2_meta_model, plan
from persist_cli.errors import PersistError
from persist_cli.recipe import Recipe, apply_overrides, make_recipe, to_plain
from persist_cli.train.distributed import check_sharded
from persist_cli.viewing.console import print_json, print_table, say, watched

COLUMNS: Final = ("weights", "gradients", "optimizer", "average", "encoding", "activations", "update", "peak")

OF_A_MACHINE: Final = 8  # GPUs, where there are several machines

EACH_MACHINE: Final = "--machine_rank R --main_process_ip HOST --main_process_port 29500"  # R counts them from 0

MOST_SAMPLES: Final = 4096  # of a micro-batch


@dataclass(frozen=True)
class Finding:
    """What a strategy needs.

    Args:
        recipe: by name.
        strategy: changes of it.
        need: of one device.
        fits: whether it has that.
    """

    recipe: str
    strategy: Strategy
    need: MemoryEstimate
    fits: bool


class Doctor:
    """Examines a plan on a machine.

    Args:
        planned: the recipe with its backbone.
        machine: to train on.
        sharded: whether FSDP2 is used anyway.
        stage2: the plan of a stage 2 on this stage 1, to compare with.
    """

    def __init__(self, planned: MetaModel, machine: Machine, sharded: bool, stage2: MetaModel | None = None) -> None:
        self.planned, self.machine, self.sharded = planned, machine, sharded
        self.stage2 = stage2
        self.estimators = {planned.recipe.lora: Estimator(planned.backbone, planned.channels)}
        self.changes = changes_of(planned.recipe, machine, sharded)

    def examine(self, strategy: Strategy) -> Finding:
        """What the recipe needs with these changes."""
        recipe, launch = self.changed(strategy), self.launch(strategy)
        need = self.estimator(recipe).need(recipe, launch)
        return Finding(self.planned.name, strategy, need, need.peak <= self.machine.usable)

    def fits(self, strategy: Strategy) -> bool:
        """Whether these changes suffice."""
        recipe, launch = self.changed(strategy), self.launch(strategy)
        hopeless = self.estimator(recipe).at_least(recipe, launch).peak > self.machine.usable
        return not hopeless and self.examine(strategy).fits

    def launch(self, strategy: Strategy) -> Launch:
        """How the processes share the work."""
        sharded, offloaded = self.sharded or strategy.sharded, OFFLOADED in strategy.flags
        return Launch(self.machine.devices, self.machine.kind == "cuda", sharded, offloaded)

    def estimator(self, recipe: Recipe) -> Estimator:
        """That of the recipe's parameters, which LoRA changes."""
        if recipe.lora not in self.estimators:
            other = plan(self.planned.name, recipe, self.planned.base)
            self.estimators[recipe.lora] = Estimator(other.backbone, other.channels)
        return self.estimators[recipe.lora]

    def changed(self, strategy: Strategy) -> Recipe:
        """The recipe with the strategy's settings."""
        return make_recipe(apply_overrides(to_plain(self.planned.recipe), strategy.settings), strategy.name)

    def each(self) -> list[Finding]:
        """The recipe as it is, with each change alone, and stage 2 as its own recipe is."""
        works = [partial(self.examine, Strategy((change,) if change else ())) for change in (None, *self.changes)]
        if self.stage2 is not None:
            works.append(partial(self.examine_stage2, self.stage2))
        return [work() for work in watched(works, "each alone", "strategy")]

    def examine_stage2(self, planned: MetaModel) -> Finding:
        """What a stage 2 needs."""
        found = Doctor(planned, self.machine, self.sharded).examine(Strategy())
        return dataclasses.replace(found, strategy=STAGE2)

    def smallest(self) -> Finding | None:
        """What fits with the smallest changes, ``None`` when nothing does."""
        found = smallest(self.changes, self.fits)
        return None if found is None else self.examine(found)


def run_doctor(name: str, overrides: Sequence[str], machine: Machine, sharded: bool, json: bool) -> None:
    """Print parts, what each strategy needs, and what fits.

    Raises:
        PersistError: when the recipe is wrong or cannot be shared by the devices, or FSDP2 is asked for on one.
    """
    if sharded and machine.devices == 1:
        raise PersistError("--fsdp shares a model out over several GPUs; give --gpus N too")
    planned = build_meta_model(name, overrides)
    training = planned.recipe.training
    check_batch_division(training.batch, training.accumulation, machine.devices)
    samples = training.samples_at_once(machine.devices)
    if samples > MOST_SAMPLES:
        raise PersistError(f"{samples} samples at once on a device: no plan is made of more than {MOST_SAMPLES}")
    if sharded:
        planned.backbone.trained_parameters(planned.recipe.stage)
        check_sharded(planned.recipe, planned.backbone)
    doctor = Doctor(planned, machine, sharded, build_stage2_meta_model(planned, overrides))
    parts, found, best = dry_run(planned), doctor.each(), doctor.smallest()
    if json:
        print_json(_record(machine, parts, found, best))
        return
    rows = [[part["name"], f"{part['parameters']:,}", gib(part["bytes"])] for part in [*parts["parts"], parts["total"]]]
    print_table(f"{name}: stage {planned.recipe.stage}", ("part", "parameters", "GiB"), rows)
    title = f"GiB on each of {machine}, of which {gib(machine.usable)} are planned with"
    print_table(title, ("strategy", *COLUMNS, "fits"), [_row(each) for each in found])
    say(_verdict(doctor, overrides, best))


def _verdict(doctor: Doctor, overrides: Sequence[str], best: Finding | None) -> str:
    machine = doctor.machine
    if best is None:
        return f"does not fit on {machine}, whatever is changed; take more or larger devices, or smaller clips"
    how = f"with {best.strategy.name}" if best.strategy.changes else "as it is"
    need = f"{gib(best.need.peak)} of {gib(machine.usable)} GiB"
    if best.need.host:
        need += f", and {gib(best.need.host)} GiB of the memory of the CPU"
    return f"fits {how} ({need}):\n{command(doctor, overrides, best.strategy)}"


def command(doctor: Doctor, overrides: Sequence[str], strategy: Strategy) -> str:
    """How to start the training like that, for a shell."""
    begin = ["backbone.settings.pretrained=DIR"] if doctor.planned.from_nothing else []
    settings = [shlex.quote(each) for each in (*overrides, *strategy.settings, *begin)]
    finetune = " ".join(["finetune", shlex.quote(doctor.planned.name), "--data DATA", *settings])
    flags = list(dict.fromkeys([SHARDED, *strategy.flags])) if doctor.sharded else strategy.flags
    devices = doctor.machine.devices
    if devices == 1 and not flags:
        return f"persist {finetune}"
    kind = " ".join(flags or ["--multi_gpu"])
    machines, left = divmod(devices, OF_A_MACHINE)
    spread = f"--num_machines {machines} {EACH_MACHINE} " if machines > 1 and not left else ""
    return f"accelerate launch {spread}--num_processes {devices} {kind} --module persist_cli {finetune}"


def _record(machine: Machine, parts: dict[str, Any], found: Sequence[Finding], best: Finding | None) -> dict[str, Any]:
    for part in parts["parts"]:
        del part["shapes"]
    return {
        "recipe": found[0].recipe,
        "machine": {
            "kind": machine.kind, "devices": machine.devices, "memory": machine.memory, "usable": machine.usable,
        },
        **parts,
        "strategies": [_finding(each) for each in found],
        "fits": found[0].fits,
        "smallest": None if best is None else _finding(best),
    }  # fmt: skip


def _finding(found: Finding) -> dict[str, Any]:
    return {
        "name": found.strategy.name,
        "recipe": found.recipe,
        "settings": found.strategy.settings,
        "launch": found.strategy.flags,
        "need": found.need.to_json(),
        "fits": found.fits,
    }


def _row(found: Finding) -> list[str]:
    need = found.need.to_json()
    return [found.strategy.name, *(gib(need[column]) for column in COLUMNS), "yes" if found.fits else "no"]
