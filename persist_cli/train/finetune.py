"""``persist finetune``: a recipe and a data set in, a run folder with checkpoints out."""

from __future__ import annotations

import contextlib
import importlib.util
import itertools
import json
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any, Final

import torch
from accelerate import Accelerator
from accelerate.utils import GradientAccumulationPlugin, InitProcessGroupKwargs, set_seed

from persist_cli.api.backbone import Backbone
from persist_cli.api.cells import COMMON, CellForm
from persist_cli.api.checkpoint import (
    PLAIN,
    Checkpoint,
    base_pointer,
    find_checkpoint,
    read_card,
    step_folders,
)
from persist_cli.api.inference import SamplingOverrides
from persist_cli.api.meta_device import without_weights
from persist_cli.api.policy_network import PolicyNetwork
from persist_cli.api.scene_model import SceneModel
from persist_cli.api.stages import SCENE_STAGES
from persist_cli.api.training_scenes import TrainingScenes
from persist_cli.checkpoints.load import (
    add_adapter,
    is_distilled,
    start_backbone,
    starts_from_random_codec,
    with_adapter,
    with_scene_paths,
)
from persist_cli.checkpoints.placement import warn_if_slow
from persist_cli.checkpoints.relink import weights_at
from persist_cli.checkpoints.scene_models import TrainedSceneModel, check_stage, find_scene_model
from persist_cli.errors import PersistError, RecipeError
from persist_cli.io.command_line import quoted
from persist_cli.io.exclusive import exclusive
from persist_cli.io.files import check_folder
from persist_cli.io.signals import repeated_signals
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.output.console import busy, say, warn
from persist_cli.plugins import make_scene_model
from persist_cli.policies.trained import find_policy, make_network
from persist_cli.recipe import (
    Recipe,
    apply_overrides,
    changeable_on_resume,
    make_recipe,
    network_of,
    read_recipe,
    recipe_names,
    recipe_values,
    to_plain,
)
from persist_cli.train.distributed import (
    explain_lost_processes,
    fsdp_plugin,
    last_checkpoint,
    use_fsdp_on_cpus,
    use_zero_on_cpus,
    zero_plugin,
)
from persist_cli.train.policy_trainer import PolicyTrainer
from persist_cli.train.run_folder import RunFolder
from persist_cli.train.scene_trainer import SceneTrainer
from persist_cli.train.sources import (
    check_scene_model,
    distilled,
    has_same_data,
    held_sources,
    known_hashes,
    knows_other_data,
    knows_scene_model,
    with_computed_settings,
    with_own_adapter,
)
from persist_cli.train.state import load_state
from persist_cli.train.stopping import StopSignal, end_at_once
from persist_cli.train.tensor_cache import CacheSettings
from persist_cli.train.trainer import Trainer
from persist_cli.train.training_loop import TrainingLoop

LONGEST_WAIT: Final = timedelta(hours=1)  # for a process that does not answer, as while it writes a large model

RANDOM_CODEC: Final = (
    "begins with random weights, those of the codec too; give backbone.settings.pretrained=DIR for a pretrained model, "
    "or base=RUN for a codec trained here"
)

OTHER_DATA: Final = (
    "its data have changed since it was stopped; it goes on with what is there, and will not equal a run that was not "
    "stopped"
)

DISTILLED_BASE: Final = (
    "stands on a distilled base and is not distilled itself, but will be sampled in as few steps; set distill too, as "
    "houses-64-distill-voxel does, or give base=RUN of the model that was distilled"
)


@dataclass(frozen=True, kw_only=True)
class FinetunePlan:
    """The options of ``persist finetune``; see its help."""

    recipe: str
    overrides: Sequence[str] = ()
    data: Sequence[str] = ()
    out: Path | None = None
    resume: bool = False
    cache: CacheSettings | None = None
    profile: bool = False


def run_finetune(plan: FinetunePlan) -> None:
    """Train a stage and leave a run folder; see ``persist finetune --help``."""
    values = apply_overrides(read_recipe(plan.recipe), plan.overrides)
    if plan.data:
        values = apply_overrides(values, [f"data.path={json.dumps([*plan.data])}"])
    run = plan.out or Path("runs") / Path(plan.recipe).stem
    begun = run if plan.resume and step_folders(run) and not values.get("distill") else None
    recipe = make_recipe(with_scene_paths(with_adapter(values, begun)), plan.recipe)
    if not recipe.data.path:
        raise RecipeError(f"{plan.recipe}: no data set; give --data DIR")
    check_run(run, recipe, plan.resume)
    lost = explain_lost_processes(partial(last_checkpoint, run))
    with repeated_signals(end_at_once), limited_threads(recipe.training.threads), lost:
        ended_by = finetune(recipe, run, plan)
    if ended_by is not None:
        sys.exit(128 + ended_by)  # as a shell says that a signal ended a command: it must not go on with the next


@contextlib.contextmanager
def limited_threads(threads: int) -> Iterator[None]:
    """Within the block torch has so many CPU threads; 0 leaves the number to torch."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def check_run(run: Path, recipe: Recipe, resume: bool) -> None:
    """Raise ``PersistError`` when no run can be written there, or when this is not the run in the folder to go on with.

    Settings that ``changeable_on_resume`` names may be others than those of the run in the folder, and the base, what
    is distilled, the model that imagines and the data may be at another place.
    """
    check_folder(run)
    steps = step_folders(run)
    if not steps:
        return
    if not resume:
        raise PersistError(f"{run}: holds a run already; go on with --resume or choose another --out")
    path = run / "recipe.yaml"
    values = recipe_values(path)
    # settings that the run's version did not have get their defaults
    before = to_plain(make_recipe(with_scene_paths(values), str(path)))
    found_by_weights = known_hashes(run).keys() & distilled(recipe).keys()
    changeable = changeable_on_resume() | found_by_weights | {"chosen_on", "description"}  # which change no weight
    changeable |= {"memory.settings.model"} if knows_scene_model(run) else set()
    changed = [key for key in _different_keys(before, to_plain(recipe), "") if key not in changeable]
    pointer = base_pointer(read_card(steps[-1] / "model")) if network_of(recipe) is None else None
    if "base" in changed and recipe.base and pointer and weights_at(recipe.base, pointer):
        changed.remove("base")
    if "data.path" in changed and has_same_data(recipe, run):
        changed.remove("data.path")
    if changed:
        raise RecipeError(f"{run}: cannot resume with another recipe; {', '.join(changed)} changed")
    check_scene_model(recipe, run)


def finetune(recipe: Recipe, run: Path, plan: FinetunePlan) -> int | None:
    """Train to the recipe's last step or to a signal, from the run's last checkpoint where there is one.

    Args:
        recipe: the resolved recipe.
        run: the run's folder.
        plan: the options of the command, of which ``cache`` and ``profile`` are read here.

    Returns:
        The signal that ended the run before its last step, ``None`` when it reached that.
    """
    accelerator = make_accelerator(recipe, run)
    with contextlib.ExitStack() as from_the_first_step:
        with exclusive(run, accelerator.is_main_process), held_sources(recipe, run) as (recipe, base):
            with busy("loading model and data"):  # a signal ends it: there is nothing to save
                trainer = prepare_trainer(recipe, run, base, accelerator, plan)
                folder = prepare_run(trainer, run, base, plan)
            stop = from_the_first_step.enter_context(StopSignal.awaited())
            ended_by = trainer.train(folder.log, folder.save, stop)
            with busy("saving the checkpoint"):
                kept = folder.finish()
        ended_by = ended_by if trainer.state.step < recipe.training.steps else None
        if accelerator.is_main_process:
            trainer.times.report(run / "profile.json")
            report(recipe, run, trainer.state.step, folder.speed.rate())
            say(f"{len(kept)} checkpoint{'s' * (len(kept) > 1)} kept: {', '.join(map(str, kept))}")
            if ended_by is None:
                say(f"next: {next_command(plan.recipe, recipe, run)}")
        accelerator.wait_for_everyone()  # as soon as one has ended by a signal, a launcher ends the others
        accelerator.end_training()
    return ended_by


def prepare_trainer(
    recipe: Recipe, run: Path, base: Checkpoint | None, accelerator: Accelerator, plan: FinetunePlan
) -> TrainingLoop[Any]:
    """The trainer of a recipe, which begins at its base or with fresh weights."""
    if recipe.policy is not None:
        return PolicyTrainer(recipe, *prepare_policy(recipe, run, plan), accelerator)
    if recipe.scene is not None:
        return SceneTrainer(recipe, *prepare_scene_model(recipe, run), accelerator, plan.cache)
    factory = MemoryFactory.of(recipe.memory, accelerator.device) if recipe.memory else None
    begun_with = with_own_adapter(recipe, run)
    if base is None:
        begun_with = with_computed_settings(begun_with, run)
    backbone = prepare_backbone(begun_with, base, factory)
    if accelerator.is_main_process and starts_from_random_codec(recipe, backbone):
        warn(f"{run}: {RANDOM_CODEC}")
    if accelerator.is_main_process and base and factory and recipe.distill is None and is_distilled(base):
        warn(f"{run}: {DISTILLED_BASE}")
    return Trainer(recipe, backbone, factory, accelerator, plan.cache)


def prepare_run(trainer: TrainingLoop[Any], run: Path, base: Checkpoint | None, plan: FinetunePlan) -> RunFolder:
    """The run's folder, with its trainer in the state of the folder's newest checkpoint where there is one."""
    trainer.times.enabled = plan.profile
    load_state(run, trainer.state)
    if trainer.accelerator.is_main_process and knows_other_data(trainer.recipe, run):
        warn(f"{run}: {OTHER_DATA}")
    if trainer.accelerator.log_with:
        trainer.accelerator.init_trackers("persist")
    return RunFolder(run, trainer, base)


def prepare_policy(recipe: Recipe, run: Path, plan: FinetunePlan) -> tuple[PolicyNetwork, TrainingScenes]:
    """The network to train, fresh or that of the policy that ``base`` names, and the scenes that it was trained on.

    A resumed run does not read its base again: its newest checkpoint names the base's scenes too.

    Raises:
        PersistError: when the base is not there or is another policy, or a cache is asked for.
    """
    assert recipe.policy is not None
    if plan.cache is not None:
        raise RecipeError("--cache keeps what is made of clips; a policy has none, leave it out")
    network = make_network(recipe.policy.name, recipe.policy.settings)
    steps = step_folders(run)
    if not steps and recipe.base is None:
        return network, TrainingScenes()
    begun = find_policy(steps[-1] if steps else Path(str(recipe.base)))
    if begun.plugin != recipe.policy.name:
        raise RecipeError(f"base {recipe.base} is of policy {begun.plugin!r}, not {recipe.policy.name!r}")
    if not steps:
        network.load(begun.folder)
    return network, begun.training_scenes or TrainingScenes(complete=False)


def prepare_scene_model(recipe: Recipe, run: Path) -> tuple[SceneModel, TrainingScenes]:
    """The model to train, with the weights of its base or of the run's newest checkpoint, and the scenes of these.

    A later stage begins with what its base has of the stages before it.

    Raises:
        PersistError: when the base is not there, or is another model, or the model has no such stage.
    """
    assert recipe.scene is not None
    model = make_scene_model(recipe.scene.name, recipe.scene.settings)
    check_stage(model, recipe.stage)
    steps = step_folders(run)
    if not steps and recipe.base is None:
        return model, TrainingScenes()
    begun = find_scene_model(steps[-1] if steps else str(recipe.base))
    if begun.plugin != recipe.scene.name:
        raise RecipeError(f"base {recipe.base} is a model of scenes {begun.plugin!r}, not {recipe.scene.name!r}")
    if begun.stage == "scene-codec" and recipe.stage == "scene-outcome":
        raise RecipeError(f"base {recipe.base} is the codec of a model of scenes alone; name a run of stage scene")
    if not steps:
        check_settled(begun, model, recipe)
        if SCENE_STAGES.index(begun.stage) > SCENE_STAGES.index(recipe.stage) > 0:
            lost = f"what stage {begun.stage} learned is not kept; train that stage again on this run"
            warn(f"base {recipe.base}: {lost}")
    begun.load_into(model, min(begun.stage, recipe.stage, key=SCENE_STAGES.index))
    return model, begun.training_scenes or TrainingScenes(complete=False)


def check_settled(begun: TrainedSceneModel, model: SceneModel, recipe: Recipe) -> None:
    """Raise ``RecipeError`` when a model has other settings than what its base learned in an earlier stage."""
    with without_weights():
        before = asdict(make_scene_model(begun.plugin, begun.settings).settings)
    after = asdict(model.settings)
    for stage in itertools.takewhile(lambda stage: stage != recipe.stage, SCENE_STAGES):
        part = model.settled.get(stage, "")
        for name, value in before.get(part, {}).items():
            if value != after[part][name]:
                key = f"scene.settings.{part}.{name}"
                raise RecipeError(
                    f"base {recipe.base}: its stage {stage} was trained with {key}={value}, not {after[part][name]}; "
                    "give that, or train that stage again"
                )


def make_accelerator(recipe: Recipe, run: Path) -> Accelerator:
    """Accelerate for this process, in the recipe's precision and with its tracker; sets the random seed too.

    Raises:
        PersistError: when the tracker is not installed.
    """
    settings = recipe.training
    tracker = None if settings.tracker == "none" else settings.tracker
    if tracker and importlib.util.find_spec(tracker) is None:
        raise PersistError(
            f"training.tracker={tracker} needs the package {tracker}: pip install 'persist-cli[{tracker}]'"
        )
    fsdp, zero = fsdp_plugin(settings.precision), zero_plugin(settings)
    accelerator = Accelerator(
        mixed_precision=settings.precision if zero is None else "no",  # DeepSpeed has its own way
        log_with=tracker,
        project_dir=run,
        cpu=not torch.cuda.is_available(),
        fsdp_plugin=fsdp,
        deepspeed_plugin=zero,
        gradient_accumulation_plugin=GradientAccumulationPlugin(num_steps=1),  # else the environment's divides the loss
        kwargs_handlers=[InitProcessGroupKwargs(timeout=LONGEST_WAIT)],
    )
    if accelerator.is_main_process and settings.precision == "bf16" and not torch.cuda.is_available():
        warn_if_slow("training.precision=bf16", torch.bfloat16, "give training.precision=no")
    use_fsdp_on_cpus(fsdp)
    use_zero_on_cpus(zero)
    set_seed(settings.seed)
    return accelerator


def prepare_backbone(recipe: Recipe, base: Checkpoint | None, factory: MemoryFactory | None) -> Backbone:
    """The backbone to train: fresh or that of the base, with a fresh LoRA or memory adapter where the recipe has one.

    Raises:
        RecipeError: when LoRA has no weights to change.
    """
    backbone = start_backbone(recipe, base)
    if recipe.lora is not None:
        if base is None and not backbone.origin():
            raise RecipeError("lora changes weights that are there; give base=RUN, or pretrained backbone.settings")
        backbone.add_lora(recipe.lora)
    if recipe.memory is not None and factory is not None:
        add_adapter(backbone, recipe, recipe.memory.name, factory.encoder.channels)
    return backbone


def report(recipe: Recipe, run: Path, step: int, rate: float) -> None:
    """Print one line about how the run ended and how fast it went."""
    if step < recipe.training.steps:
        where = f"checkpoint in {run}, go on with --resume"
        say(f"stopped at step {step} of {recipe.training.steps} ({rate:.3g} samples/s); {where}")
    else:
        done = f"trained {step} steps of {recipe.training.batch} samples ({rate:.3g} samples/s)"
        say(f"stage {recipe.stage} {done}; checkpoint in {run}")
    if recipe.distill is not None or recipe.adversarial is not None:
        how = "distilled" if recipe.distill is not None else "trained adversarially"
        say(f"{how}: its checkpoint asks for {find_checkpoint(run).sampling_with(SamplingOverrides()).words}")


def next_command(name: str, recipe: Recipe, run: Path) -> str:
    """The command that one usually gives after a stage.

    Args:
        name: the name of the stage's recipe, or its file.
        recipe: the recipe.
        run: the run's folder.
    """
    trained = quoted(run)
    if recipe.policy is not None:
        return f"persist bench plan --policy {trained}"
    data = " ".join(f"--data {quoted(folder)}" for folder in recipe.data.path)
    if recipe.stage == "scene-codec":
        following = name.removesuffix("-codec")
        known = following if following != name and following in recipe_names() else "RECIPE"
        return f"persist finetune {known} {data} base={trained}"
    if recipe.stage == "scene-outcome":
        return f"persist bench scene {trained} --data HELD_OUT_DATA --parts evolution --out runs/bench-evolution"
    if recipe.stage == "scene":
        houses = quoted(recipe.data.path[0])
        settings = recipe.scene.settings if recipe.scene is not None else {}
        if CellForm(palette=tuple(settings.get("palette", COMMON))).of_depth:
            return f"persist memorize {houses}#0:0 --memory scene --model {trained} --complete"
        return f"persist bench scene {trained} --data HELD_OUT_DATA --train {houses} --out runs/bench-scene"
    if recipe.distill is not None and recipe.stage == "1":
        return f"persist eval {trained} --data HELD_OUT_DATA --memories {PLAIN}"
    if recipe.memory is not None:
        return f"persist eval {trained} --data HELD_OUT_DATA --memories {PLAIN},{recipe.memory.name}"
    stage = re.fullmatch(r"(.+)-(?:codec|stage1)(.*)", name)
    following = "stage1" if recipe.stage == "codec" else "stage2-voxel"
    guesses = [f"{stage[1]}-{following}{stage[2]}", f"{stage[1]}-{following}"] if stage else []
    known = next((guess for guess in guesses if guess in recipe_names()), "RECIPE")
    return f"persist finetune {known} {data} base={trained}"


def _different_keys(before: Any, now: Any, key: str) -> list[str]:
    """Dotted keys of the values that differ between two nested mappings."""
    if isinstance(before, dict) and isinstance(now, dict):
        names = sorted(set(before) | set(now))
        keys = [_different_keys(before.get(name), now.get(name), f"{key}.{name}".strip(".")) for name in names]
        return [*itertools.chain.from_iterable(keys)]
    return [] if before == now else [key]
