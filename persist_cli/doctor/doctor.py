"""``persist doctor``: what a training needs on a machine, and the smallest change that makes it fit."""

from __future__ import annotations

import dataclasses
import importlib.util
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from persist_cli.api.stages import Lora
from persist_cli.data.clips import check_batch_division
from persist_cli.doctor.changes import (
    BITSANDBYTES,
    EIGHT_BIT,
    LORA,
    OFFLOADED,
    SAVINGS,
    SHARDED,
    STAGE2,
    Change,
    Strategy,
    available_changes,
    smallest_fitting,
)
from persist_cli.doctor.dry_run import dry_run, network_dry_run, network_recipe
from persist_cli.doctor.machine import Machine, gib
from persist_cli.doctor.memory_estimate import Estimator, Launch, MemoryEstimate
from persist_cli.doctor.meta_model import (
    MetaModel,
    SceneMetaModel,
    build_meta_model,
    build_scene_meta_model,
    build_stage2_meta_model,
)
from persist_cli.doctor.step import check_savings
from persist_cli.errors import PersistError
from persist_cli.output.console import busy, print_json, print_table, say, watched
from persist_cli.recipe import Recipe, apply_overrides, make_recipe, of_the_whole_model, to_plain
from persist_cli.train.distributed import check_sharded

COLUMNS: Final = ("weights", "gradients", "optimizer", "average", "encoding", "activations", "update", "peak")

OF_A_MACHINE: Final = 8  # GPUs, where there are several machines

EACH_MACHINE: Final = "--machine_rank R --main_process_ip HOST --main_process_port 29500"  # R counts them from 0

MOST_SAMPLES: Final = 4096  # of a micro-batch


@dataclass(frozen=True)
class Finding:
    """The memory that a recipe needs with a strategy.

    Args:
        recipe: the name of the recipe.
        strategy: the changes that are made to it.
        estimate: the memory that one device needs.
        fits: whether each device has as much.
    """

    recipe: str
    strategy: Strategy
    estimate: MemoryEstimate
    fits: bool


class Doctor:
    """Examines the training of a recipe on a machine.

    Args:
        meta_model: the recipe with its backbone, or its model of scenes.
        machine: the machine to train on.
        sharded: whether the training uses FSDP2, whatever else is changed.
    """

    def __init__(self, meta_model: MetaModel | SceneMetaModel, machine: Machine, sharded: bool) -> None:
        self.meta_model, self.machine, self.sharded = meta_model, machine, sharded
        self.stage2: MetaModel | None = None
        self.estimators: dict[Lora | None, Estimator] = {meta_model.recipe.lora: meta_model.estimator()}
        self.not_considered: dict[str, str] = {}  # changes that cannot be made here, and why
        changes = available_changes(meta_model.recipe, machine, sharded)
        self.changes = [change for change in changes if self.can_make(change)]

    def can_make(self, change: Change) -> bool:
        """Whether backbone and installation can make a change that they may lack; else it is ``not_considered``."""
        recipe = self.changed_recipe(Strategy((change,)))
        try:
            if change is LORA:
                self.estimator(recipe)
            elif change in SAVINGS and isinstance(self.meta_model, MetaModel):
                check_savings(self.meta_model.backbone, recipe)
        except PersistError as error:
            self.not_considered[change.name] = str(error)
            return False
        return True

    def compare_stage2(self, overrides: Sequence[str]) -> None:
        """Compare with the stage 2 that stands on this stage 1, where persist has one; else say why it cannot be."""
        assert isinstance(self.meta_model, MetaModel)
        try:
            self.stage2 = build_stage2_meta_model(self.meta_model, overrides)
        except PersistError as error:
            self.not_considered[STAGE2.name] = str(error)

    def examine(self, strategy: Strategy) -> Finding:
        """Estimate what the recipe needs with these changes."""
        recipe, launch = self.changed_recipe(strategy), self.launch(strategy)
        estimate = self.estimator(recipe).estimate(recipe, launch)
        return Finding(self.meta_model.name, strategy, estimate, estimate.peak <= self.machine.usable)

    def fits(self, strategy: Strategy) -> bool:
        """Whether the training fits with these changes."""
        recipe, launch = self.changed_recipe(strategy), self.launch(strategy)
        hopeless = self.estimator(recipe).without_step(recipe, launch).peak > self.machine.usable
        return not hopeless and self.examine(strategy).fits

    def launch(self, strategy: Strategy) -> Launch:
        """The processes that the training is spread over with these changes."""
        sharded, offloaded = self.sharded or strategy.sharded, OFFLOADED in strategy.flags
        return Launch(
            devices=self.machine.devices, cuda=self.machine.kind == "cuda", sharded=sharded, offloaded=offloaded
        )

    def estimator(self, recipe: Recipe) -> Estimator:
        """The estimator for the recipe's parameters, which only LoRA changes."""
        if recipe.lora not in self.estimators and isinstance(self.meta_model, MetaModel):
            changed = MetaModel.of(self.meta_model.name, recipe, self.meta_model.base)
            self.estimators[recipe.lora] = changed.estimator()
        return self.estimators[recipe.lora]

    def changed_recipe(self, strategy: Strategy) -> Recipe:
        """The recipe with the strategy's settings."""
        return make_recipe(apply_overrides(to_plain(self.meta_model.recipe), strategy.settings), strategy.name)

    def findings(self) -> list[Finding]:
        """The findings for the recipe as it is, for it with each change alone, and for stage 2 as its own recipe is."""
        works = [partial(self.examine, Strategy((change,) if change else ())) for change in (None, *self.changes)]
        if self.stage2 is not None:
            works.append(partial(self.examine_stage2, self.stage2))
        return [work() for work in watched(works, "each alone", "strategies")]

    def examine_stage2(self, stage2: MetaModel) -> Finding:
        """Estimate what a stage 2 needs."""
        finding = Doctor(stage2, self.machine, self.sharded).examine(Strategy())
        return dataclasses.replace(finding, strategy=STAGE2)

    def smallest(self) -> Finding | None:
        """The finding for the smallest changes that make the training fit, ``None`` when none do."""
        strategy = smallest_fitting(self.changes, self.fits)
        return None if strategy is None else self.examine(strategy)


def run_doctor(name: str, overrides: Sequence[str], machine: Machine, sharded: bool, json: bool) -> None:
    """Print the parts of the model, what each strategy needs, and what fits.

    Raises:
        PersistError: when the recipe is wrong or cannot be shared by the devices, or when FSDP2 has only one.
    """
    if sharded and machine.devices == 1:
        raise PersistError("--fsdp shares a model out over several GPUs; give --gpus N too")
    meta_model = _plan_of(name, overrides)
    training = meta_model.recipe.training
    check_batch_division(training.batch, training.accumulation, machine.devices)
    samples = training.samples_at_once(machine.devices)
    if samples > MOST_SAMPLES:
        raise PersistError(f"{samples} samples at once on a device: no plan is made of more than {MOST_SAMPLES}")
    if sharded and isinstance(meta_model, SceneMetaModel):
        raise PersistError("--fsdp: a model of scenes is not sharded; leave it out")
    if sharded and (whole := of_the_whole_model(meta_model.recipe)):
        raise PersistError(f"--fsdp: {whole[0]} needs the whole model in each process; leave it out")
    if sharded and isinstance(meta_model, MetaModel):
        meta_model.backbone.trained_parameters(meta_model.recipe.stage)
        check_sharded(meta_model.recipe, meta_model.backbone)
    with busy("building the model without weights"):
        if isinstance(meta_model, SceneMetaModel):
            doctor, model = Doctor(meta_model, machine, sharded), network_dry_run(meta_model.recipe)
        else:
            doctor, model = Doctor(meta_model, machine, sharded), dry_run(meta_model)
            doctor.compare_stage2(overrides)
    findings, best = doctor.findings(), doctor.smallest()
    if json:
        print_json(_record(machine, model, findings, best) | {"not_considered": doctor.not_considered})
        return
    parts = [*model["parts"], model["total"]]
    rows = [[part["name"], f"{part['parameters']:,}", gib(part["bytes"])] for part in parts]
    print_table(f"{name}: stage {meta_model.recipe.stage}", ("part", "parameters", "GiB"), rows)
    title = f"GiB on each of {machine}, of which {gib(machine.usable)} are planned with"
    print_table(title, ("strategy", *COLUMNS, "fits"), [_row(finding) for finding in findings])
    for change, cause in doctor.not_considered.items():
        say(f"not considered: {change} ({cause})")
    say(_verdict(doctor, overrides, best))


def _plan_of(name: str, overrides: Sequence[str]) -> MetaModel | SceneMetaModel:
    """The recipe with its backbone, or its model of scenes, without weights."""
    recipe = network_recipe(name, overrides)
    if recipe is None or recipe.scene is None:
        return build_meta_model(name, overrides)
    return build_scene_meta_model(name, recipe)


def _verdict(doctor: Doctor, overrides: Sequence[str], best: Finding | None) -> str:
    machine = doctor.machine
    if best is None:
        return f"does not fit on {machine}, whatever is changed; take more or larger devices, or smaller clips"
    changes = f"with {best.strategy.name}" if best.strategy.changes else "as it is"
    need = f"{gib(best.estimate.peak)} of {gib(machine.usable)} GiB"
    if best.estimate.host:
        need += f", and {gib(best.estimate.host)} GiB of the memory of the CPU"
    needed = ""
    if EIGHT_BIT in best.strategy.changes and importlib.util.find_spec(BITSANDBYTES) is None:
        needed = f"pip install 'persist-cli[{BITSANDBYTES}]'\n"
    return f"fits {changes} ({need}):\n{needed}{launch_command(doctor, overrides, best.strategy)}"


def launch_command(doctor: Doctor, overrides: Sequence[str], strategy: Strategy) -> str:
    """The command line that starts the training with a strategy, for a shell."""
    pretrained = ["backbone.settings.pretrained=DIR"] if doctor.meta_model.begins_random else []
    settings = [shlex.quote(setting) for setting in (*overrides, *strategy.settings, *pretrained)]
    finetune = " ".join(["finetune", shlex.quote(doctor.meta_model.name), "--data DATA", *settings])
    flags = list(dict.fromkeys([SHARDED, *strategy.flags])) if doctor.sharded else strategy.flags
    devices = doctor.machine.devices
    if devices == 1 and not flags:
        return f"persist {finetune}"
    kind = " ".join(flags or ["--multi_gpu"])
    machines, left = divmod(devices, OF_A_MACHINE)
    spread = f"--num_machines {machines} {EACH_MACHINE} " if machines > 1 and not left else ""
    return f"accelerate launch {spread}--num_processes {devices} {kind} --module persist_cli {finetune}"


def _record(
    machine: Machine, model: dict[str, Any], findings: Sequence[Finding], best: Finding | None
) -> dict[str, Any]:
    for part in model["parts"]:
        del part["shapes"]
    return {
        "recipe": findings[0].recipe,
        "machine": {
            "kind": machine.kind, "devices": machine.devices, "memory": machine.memory, "usable": machine.usable,
        },
        **model,
        "strategies": [_to_json(finding) for finding in findings],
        "fits": findings[0].fits,
        "smallest": None if best is None else _to_json(best),
    }  # fmt: skip


def _to_json(finding: Finding) -> dict[str, Any]:
    return {
        "name": finding.strategy.name,
        "recipe": finding.recipe,
        "settings": finding.strategy.settings,
        "launch": finding.strategy.flags,
        "need": finding.estimate.to_json(),
        "fits": finding.fits,
    }


def _row(finding: Finding) -> list[str]:
    sizes = finding.estimate.to_json()
    return [finding.strategy.name, *(gib(sizes[column]) for column in COLUMNS), "yes" if finding.fits else "no"]
