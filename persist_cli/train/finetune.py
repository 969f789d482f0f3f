"""``persist finetune``: a recipe and a data set in, a run folder with checkpoints out."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import signal
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator
from accelerate.utils import InitProcessGroupKwargs, set_seed

from persist_cli.api.backbone import Backbone
from persist_cli.checkpoints.checkpoint import (
    Checkpoint,
    find_checkpoint,
    start_backbone,
    starts_from_random_codec,
    step_folders,
)
from persist_cli.errors import INTERRUPTED, PersistError, RecipeError
from persist_cli.io.files import check_folder
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.recipe import Recipe, apply_overrides, make_recipe, parse_yaml_mapping, read_recipe, to_plain
from persist_cli.train.clip_cache import CacheSettings
from persist_cli.train.distributed import (
    lost_processes_named,
    shard_on_cpus,
    sharding_plugin,
    zero_on_cpus,
    zero_plugin,
)
from persist_cli.train.log import StepTimes
from persist_cli.train.run_folder import RunFolder
from persist_cli.train.state import load_state
from persist_cli.train.trainer import Stop, Trainer
from persist_cli.viewing.console import say, warn

LONGEST_WAIT = timedelta(hours=1)  # for a process that neither answers nor ends, as while one writes a large model

FROM_NOTHING = (
    "begins with random weights, those of the codec too; give backbone.settings.pretrained=DIR for a pretrained model, "
    "or base=RUN for a codec trained here"
)

CHANGEABLE = {
    "steps",
    "checkpoint_every",
    "checkpoint_minutes",
    "workers",
    "threads",
    "tracker",
    "accumulation",
    "cooldown",
    "gradient_checkpointing",
    "compile",
    "ema_device",
    "vae_slicing",
}


@dataclass(frozen=True)
class FinetunePlan:
    """The options of ``persist finetune``; see its help."""

    recipe: str
    overrides: Sequence[str] = ()
    data: Sequence[Path] = ()
    out: Path | None = None
    resume: bool = False
    cache: CacheSettings | None = None
    profile: bool = False


def run_finetune(plan: FinetunePlan) -> None:
    """Train a stage and leave a run folder; see ``persist finetune --help``."""
    values = apply_overrides(read_recipe(plan.recipe), plan.overrides)
    if plan.data:
        values = apply_overrides(values, [f"data.path={json.dumps([str(each) for each in plan.data])}"])
    recipe = make_recipe(values, plan.recipe)
    if not recipe.data.path:
        raise RecipeError(f"{plan.recipe}: no data set; give --data DIR")
    run = plan.out or Path("runs") / Path(plan.recipe).stem
    check_run(run, recipe, plan.resume)
    with Stop() as stop, limited_threads(recipe.training.threads), lost_processes_named(run):
        ended_by = finetune(recipe, run, stop, plan)
    if ended_by is not None:
        sys.exit(INTERRUPTED if ended_by == signal.SIGINT else 0)


@contextlib.contextmanager
def limited_threads(threads: int) -> Iterator[None]:
    """Torch with so many CPU threads, 0 for its own choice."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def check_run(run: Path, recipe: Recipe, resume: bool) -> None:
    """Raise a one-line error when the folder is none, or holds a run and this one does not go on with it."""
    check_folder(run)
    if not step_folders(run):
        return
    if not resume:
        raise PersistError(f"{run}: holds a run already; go on with --resume or choose another --out")
    values = parse_yaml_mapping((run / "recipe.yaml").read_text(encoding="utf-8"), str(run / "recipe.yaml"))
    before = to_plain(make_recipe(values, str(run / "recipe.yaml")))  # with what settings that are new stand for
    changed = [key for key in _differences(before, to_plain(recipe), "") if key.split(".")[-1] not in CHANGEABLE]
    if changed:
        raise RecipeError(f"{run}: cannot resume with another recipe; {', '.join(changed)} changed")


def finetune(recipe: Recipe, run: Path, stop: Stop, plan: FinetunePlan) -> int | None:
    """Train to the recipe's last step or to a signal, from the run's last checkpoint where there is one.

    Args:
        recipe: resolved.
        run: folder of the run.
        stop: where signals are noted.
        plan: says whether to cache and to take times.

    Returns:
        The signal that ended it before its last step.
    """
    accelerator = make_accelerator(recipe, run)
    base = find_checkpoint(Path(recipe.base)) if recipe.base else None
    maker = MemoryFactory.of(recipe.memory, accelerator.device) if recipe.memory else None
    backbone = prepare_backbone(recipe, base, maker)
    if accelerator.is_main_process and starts_from_random_codec(recipe, backbone):
        warn(f"{run}: {FROM_NOTHING}")
    trainer = Trainer(recipe, backbone, maker, accelerator, plan.cache)
    if plan.profile:
        trainer.times = StepTimes(accelerator.device, recipe.training.batch)
    load_state(run, trainer.state)
    if accelerator.log_with:
        accelerator.init_trackers("persist")
    folder = RunFolder(run, trainer, base)
    ended_by = trainer.train(folder.log, folder.save, stop)
    folder.save()
    accelerator.end_training()
    ended_by = ended_by if trainer.state.step < recipe.training.steps else None
    if accelerator.is_main_process:
        if trainer.times is not None:
            trainer.times.report(run / "profile.json")
        report(recipe, run, trainer.state.step, folder.speed.rate())
    return ended_by


def make_accelerator(recipe: Recipe, run: Path) -> Accelerator:
    """One process or many in the recipe's precision, seeded, with its tracker.

    Raises:
        PersistError: when the tracker is not installed.
    """
    settings = recipe.training
    tracker = None if settings.tracker == "none" else settings.tracker
    if tracker and importlib.util.find_spec(tracker) is None:
        raise PersistError(
            f"training.tracker={tracker} needs the package {tracker}: pip install 'persist-cli[{tracker}]'"
        )
    plugin, zero = sharding_plugin(settings.precision), zero_plugin(settings)
    accelerator = Accelerator(
        mixed_precision=settings.precision if zero is None else "no",  # DeepSpeed has its own way
        log_with=tracker,
        project_dir=run,
        cpu=not torch.cuda.is_available(),
        fsdp_plugin=plugin,
        deepspeed_plugin=zero,
        kwargs_handlers=[InitProcessGroupKwargs(timeout=LONGEST_WAIT)],
    )
    shard_on_cpus(plugin)
    zero_on_cpus(zero)
    set_seed(settings.seed)
    return accelerator


def prepare_backbone(recipe: Recipe, base: Checkpoint | None, maker: MemoryFactory | None) -> Backbone:
    """The backbone to train: fresh or from the base, with fresh LoRA where asked for, a fresh adapter in stage 2."""
    backbone = start_backbone(recipe.backbone, base)
    if recipe.lora is not None:
        if base is None and not backbone.origin():
            raise RecipeError("lora changes weights that are there; give base=RUN, or pretrained backbone.settings")
        backbone.add_lora(recipe.lora)
    if recipe.memory is not None and maker is not None:
        backbone.add_adapter(recipe.memory.name, maker.encoder.channels, recipe.adapter)
    return backbone


def report(recipe: Recipe, run: Path, step: int, rate: float) -> None:
    """One line about how the run ended and how fast it went."""
    if step < recipe.training.steps:
        say(f"stopped at step {step} of {recipe.training.steps} ({rate:.3g} samples/s); go on with --resume")
    else:
        done = f"trained {step} steps of {recipe.training.batch} samples ({rate:.3g} samples/s)"
        say(f"stage {recipe.stage} {done}; checkpoint in {run}")


def _differences(before: Any, now: Any, key: str) -> list[str]:
    """Dotted keys whose values differ."""
    if isinstance(before, dict) and isinstance(now, dict):
        keys = sorted(set(before) | set(now))
        return [
            found
            for each in keys
            for found in _differences(before.get(each), now.get(each), f"{key}.{each}".strip("."))
        ]
    return [] if before == now else [key]
