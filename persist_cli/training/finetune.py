"""``persist finetune``: a recipe and a data set in, a run folder with checkpoints out."""

from __future__ import annotations

import contextlib
import importlib.util
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator
from accelerate.utils import set_seed

from persist_cli.checkpoints import Checkpoint, find_checkpoint, load_backbone, save_adapter, save_base, step_folders
from persist_cli.memorizing.recall import MemoryMaker
from persist_cli.recipe import Recipe, apply_overrides, make_recipe, parse_yaml_mapping, read_recipe, to_plain, to_yaml
from persist_cli.registry import make_backbone
from persist_cli.training.cache import Cache, CachePlace
from persist_cli.training.log import SpeedLog, StepLog
from persist_cli.training.state import load_state, save_state
from persist_cli.training.trainer import Stop, Trainer
from persist_cli.viewing.console import say
from persist_cli.world.backbone import Backbone
from persist_cli.world.errors import PersistError, RecipeError
from persist_cli.world.files import write_text

CHANGEABLE = {
    "steps",
    "checkpoint_every",
    "checkpoint_minutes",
    "workers",
    "threads",
    "tracker",
    "accumulation",
    "cooldown",
}
CODEC_BATCHES = 4  # batches that the scale of the codec's latents is measured on


def run_finetune(
    name: str, overrides: list[str], data: Path | None, out: Path | None, resume: bool, place: CachePlace | None = None
) -> None:
    """Train a stage and leave a run folder; see ``persist finetune --help``."""
    values = apply_overrides(read_recipe(name), overrides)
    if data is not None:
        values = apply_overrides(values, [f"data.path={data}"])
    recipe = make_recipe(values, name)
    if not recipe.data.path:
        raise RecipeError(f"{name}: no data set; give --data DIR")
    run = out or Path("runs") / Path(name).stem
    check_run(run, recipe, resume)
    if place is not None and recipe.stage == "codec":
        raise RecipeError("--cache: stage codec trains the codec, so it keeps no latents; leave it out")
    with Stop() as stop, limited_threads(recipe.training.threads):
        finetune(recipe, run, stop, place)
    if stop.signal is not None:
        sys.exit(130 if stop.signal == signal.SIGINT else 0)


def check_cacheable(recipe: Recipe, backbone: Backbone) -> None:
    """Raise a one-line error when a cache would never be read."""
    if not recipe.data.clips_per_trajectory and (recipe.stage == "2" or not backbone.frames_alone):
        raise RecipeError(
            "--cache: with data.clips_per_trajectory=0 hardly a clip comes twice; give it, as in "
            "data.clips_per_trajectory=32, or leave --cache out"
        )


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
    """Raise a one-line error when the folder holds a run and this one does not go on with it."""
    if not step_folders(run):
        return
    if not resume:
        raise PersistError(f"{run}: holds a run already; go on with --resume or choose another --out")
    values = parse_yaml_mapping((run / "recipe.yaml").read_text(encoding="utf-8"), str(run / "recipe.yaml"))
    before = to_plain(make_recipe(values, str(run / "recipe.yaml")))  # with what settings that are new stand for
    changed = [key for key in _differences(before, to_plain(recipe), "") if key.split(".")[-1] not in CHANGEABLE]
    if changed:
        raise RecipeError(f"{run}: cannot resume with another recipe; {', '.join(changed)} changed")


def finetune(recipe: Recipe, run: Path, stop: Stop, place: CachePlace | None = None) -> None:
    """Train to the recipe's last step or to a signal, from the run's last checkpoint where there is one."""
    settings = recipe.training
    tracker = None if settings.tracker == "none" else settings.tracker
    if tracker and importlib.util.find_spec(tracker) is None:
        raise PersistError(
            f"training.tracker={tracker} needs the package {tracker}: pip install 'persist-cli[{tracker}]'"
        )
    accelerator = Accelerator(
        mixed_precision=settings.precision, log_with=tracker, project_dir=run, cpu=not torch.cuda.is_available()
    )
    set_seed(settings.seed)
    base = find_checkpoint(Path(recipe.base)) if recipe.base else None
    maker = MemoryMaker.of(recipe.memory) if recipe.memory else None
    backbone = prepare_backbone(recipe, base, maker)
    if place is not None:
        check_cacheable(recipe, backbone)
    cache = None if place is None else Cache(place)
    trainer = Trainer(recipe, backbone, maker, accelerator, cache)
    load_state(run, trainer.state)
    if tracker:
        accelerator.init_trackers("persist")
    if accelerator.is_main_process:
        run.mkdir(parents=True, exist_ok=True)
        write_text(run / "recipe.yaml", to_yaml(recipe))
    with accelerator.main_process_first():  # it makes the folder
        log = StepLog(run / "log.jsonl", trainer.state.step)
    speed = SpeedLog(run / "speed.jsonl", trainer.state.step, settings.batch)

    def save() -> None:
        if accelerator.is_main_process:
            speed.add(trainer.state.step, trainer.keeper.figures() if trainer.keeper else {})
            save_run(run, trainer, base)
            log.draw(run / "loss.png")
        accelerator.wait_for_everyone()

    before = trainer.state.step
    trainer.train(log, save, stop)
    if trainer.state.step > before and trainer.state.step % settings.checkpoint_every and stop.signal is None:
        save()
    accelerator.end_training()
    if accelerator.is_main_process:
        report(recipe, run, trainer.state.step, stop, speed.rate())


def prepare_backbone(recipe: Recipe, base: Checkpoint | None, maker: MemoryMaker | None) -> Backbone:
    """The backbone to train: fresh or from the base, with a fresh adapter in stage 2."""
    settings = recipe.backbone.settings
    if base is None:
        backbone = make_backbone(recipe.backbone.name, settings)
    else:
        if base.backbone != recipe.backbone.name:
            raise RecipeError(f"base {base.folder} is of backbone {base.backbone!r}, not {recipe.backbone.name!r}")
        backbone = load_backbone(base, settings)
    if recipe.memory is not None and maker is not None:
        backbone.add_adapter(recipe.memory.name, maker.encoder.channels, recipe.adapter)
    return backbone


def save_run(run: Path, trainer: Trainer, base: Checkpoint | None) -> None:
    """A checkpoint of the run, its model with averaged weights where they are kept."""
    state, recipe, backbone = trainer.state, trainer.recipe, trainer.backbone

    def save_model(folder: Path) -> None:
        parameters = state.parameters.values()
        if state.average is not None:
            state.average.store(parameters)
            state.average.copy_to(parameters)
        try:
            size = recipe.training.batch
            samples = ([trainer.clips[number * size + row] for row in range(size)] for number in range(CODEC_BATCHES))
            backbone.finish_stage(recipe.stage, (trainer.to_batch(each) for each in samples))
            if recipe.memory is not None and base is not None:
                save_adapter(backbone, base, recipe.memory, folder, run / f"step-{state.step:08d}" / "model")
            else:
                save_base(backbone, folder)
            write_text(folder / "recipe.yaml", to_yaml(recipe))
        finally:
            if state.average is not None:
                state.average.restore(parameters)

    save_state(run, state, save_model)


def report(recipe: Recipe, run: Path, step: int, stop: Stop, rate: float) -> None:
    """One line about how the run ended and how fast it went."""
    if stop.signal is not None:
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
