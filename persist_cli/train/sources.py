"""The checkpoints that a run starts from: held in their own runs, and the very same again when the run goes on.

A run's base is known by the cards of its checkpoints. What a distillation reads besides, its teacher and the adapter
that is distilled, is known by the hashes of their weights in a file of the run's folder: a teacher's run may train on.
So may that of a model that imagines in the run's scenes; another one than the run began with is refused. Data sets are
known by the names and sizes of their files, wherever they are.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

from accelerate import PartialState
from accelerate.utils import broadcast_object_list

from persist_cli.api.checkpoint import (
    SHOWN,
    STEP,
    Checkpoint,
    checkpoint_folder,
    find_checkpoint,
    model_folders,
    step_folders,
)
from persist_cli.api.stages import Stage
from persist_cli.checkpoints.load import named_adapter
from persist_cli.checkpoints.relink import run_base
from persist_cli.checkpoints.retention import mark_in_use, unmark_in_use
from persist_cli.checkpoints.save import fingerprint
from persist_cli.data.reference import data_folder
from persist_cli.data.store import Store
from persist_cli.errors import CheckpointError, PersistError
from persist_cli.io.files import read_json, write_json
from persist_cli.io.sha256sums import hash_files
from persist_cli.memorize.imagining import scene_model_fingerprint
from persist_cli.plugins import load_plugin, make_settings
from persist_cli.recipe import Recipe, network_of

DISTILLED: Final = "distilled.json"  # in a run's folder: hashes of what it distils, by the recipe's keys

IMAGINED: Final = "imagined.json"  # in a run's folder: the hash of the model that imagines in its scenes

DATA: Final = "data.json"  # in a run's folder: names and bytes of the trajectories, data set by data set


def distilled(recipe: Recipe) -> dict[str, str]:
    """What a distillation reads besides its base, as the recipe names it, by the recipe's keys; empty for others."""
    if recipe.distill is None:
        return {}
    named = {"adapter_from": recipe.adapter_from, "distill.teacher": recipe.distill.teacher}
    return {key: text for key, text in named.items() if text}


def with_own_adapter(recipe: Recipe, run: Path) -> Recipe:
    """The recipe with a run's own adapter, where it goes on, in the place of the one that it began with.

    That one may be gone by then. Of a distillation it is held, as it is what is distilled.
    """
    if recipe.adapter_from is None or recipe.distill is not None or not step_folders(run):
        return recipe
    return replace(recipe, adapter_from=str(run))


def with_computed_settings(recipe: Recipe, run: Path) -> Recipe:
    """The recipe with settings of its backbone that take long to compute, which the main process does once in a run.

    All processes must call it.

    Raises:
        PersistError: in every process, when something cannot be computed.
    """
    name, given = recipe.backbone.name, recipe.backbone.settings
    settings = make_settings("backbone", name, given)
    outcome: list[Any] = [{}, ""]  # settings, or why there are none
    if PartialState().is_main_process:
        steps = step_folders(run)
        try:
            begun = steps[-1] / "model" if steps else None
            outcome[0] = load_plugin("backbone", name).compute_once(settings, run, begun)
        except PersistError as error:
            outcome[1] = str(error)  # for the others too, which would wait
    broadcast_object_list(outcome)
    if outcome[1]:
        raise PersistError(outcome[1])
    return replace(recipe, backbone=replace(recipe.backbone, settings={**given, **outcome[0]}))


def known_hashes(run: Path) -> dict[str, str]:
    """The hashes of what a run distils, which ``write_hashes`` wrote; empty for a run that has not begun."""
    path = run / DISTILLED
    return dict(read_json(path)) if step_folders(run) and path.is_file() else {}


def write_hashes(recipe: Recipe, run: Path) -> None:
    """Write into a run's folder by what its data are known, what it distils, and the model that imagines in its scenes.

    Args:
        recipe: the recipe that ``held_sources`` returned.
        run: the run's folder.
    """
    hashes = {key: weights_hash(*named_model(text, recipe.stage)) for key, text in distilled(recipe).items()}
    if hashes:
        write_json(run / DISTILLED, hashes)
    imagined = "" if recipe.memory is None else scene_model_fingerprint(recipe.memory)
    if imagined:
        write_json(run / IMAGINED, {"fingerprint": imagined})
    write_json(run / DATA, data_files(recipe))


def data_files(recipe: Recipe) -> list[list[list[Any]]]:
    """Name and bytes of each trajectory of a recipe's data sets, as JSON values."""
    folders = [data_folder(path) for path in recipe.data.path]
    return [[[file.path.name, file.file_size] for file in Store(folder)] for folder in folders]


def has_same_data(recipe: Recipe, run: Path) -> bool:
    """Whether a recipe's data are those of a run, which may have been moved since; unknown ones are not."""
    return (run / DATA).is_file() and read_json(run / DATA) == data_files(recipe)


def knows_other_data(recipe: Recipe, run: Path) -> bool:
    """Whether a run that has begun says that its data were others; those of earlier versions do not."""
    return bool(step_folders(run)) and (run / DATA).is_file() and not has_same_data(recipe, run)


def check_scene_model(recipe: Recipe, run: Path) -> None:
    """Raise ``CheckpointError`` when other weights would imagine in a run's scenes than those that it began with."""
    if recipe.memory is None or not knows_scene_model(run):
        return
    began, now = str(read_json(run / IMAGINED)["fingerprint"]), scene_model_fingerprint(recipe.memory)
    if now != began:
        raise CheckpointError(
            f"{recipe.memory.settings.get('model')}: the weights that imagine in the scenes of {run} ({began[:SHOWN]}) "
            f"are not there any more, but {now[:SHOWN] or 'none'}; give memory.settings.model=FOLDER that has them, or "
            "begin a new run"
        )


def knows_scene_model(run: Path) -> bool:
    """Whether a run that has begun says which weights imagine in its scenes; those of earlier versions do not."""
    return bool(step_folders(run)) and (run / IMAGINED).is_file()


def named_model(text: str, stage: Stage) -> tuple[Checkpoint, str | None]:
    """The checkpoint that a recipe of this stage names, and in stage 2 its adapter."""
    return (find_checkpoint(Path(text)), None) if stage == "1" else named_adapter(text)


def weights_hash(checkpoint: Checkpoint, adapter: str | None) -> str:
    """SHA-256 over the weights of a checkpoint's base, and of its adapter where one is named."""
    if adapter is None:
        return checkpoint.fingerprint
    folder = checkpoint.adapter_folder(adapter)
    names = sorted(path.name for path in folder.glob("*.safetensors"))
    return fingerprint({"base": checkpoint.fingerprint, **hash_files(folder, names)})


@contextlib.contextmanager
def held_sources(recipe: Recipe, run: Path) -> Iterator[tuple[Recipe, Checkpoint | None]]:
    """The recipe with the very checkpoints that its run distils, and the checkpoint of its base.

    Each is one for all processes, and marked in its own run, so that this one does not delete it. When the run that
    starts has no checkpoint at the end of the block, the marks are removed.

    Args:
        recipe: the recipe.
        run: the run's folder; one that goes on gets the checkpoints that it began with.

    Raises:
        CheckpointError: when one is not there.
    """
    held: list[Checkpoint] = []
    try:
        base = None
        if recipe.base is not None and network_of(recipe) is None:
            base = hold(partial(run_base, recipe.base, run), run, held)
        for key, text in distilled(recipe).items():
            find = partial(find_model, text, recipe.stage, known_hashes(run).get(key))
            recipe = _with_place(recipe, key, text, hold(find, run, held))
        yield recipe, base
    finally:
        if PartialState().is_main_process and not step_folders(run):
            for checkpoint in held:
                unmark_in_use(checkpoint, run)


def hold(find: Callable[[], Checkpoint], run: Path, held: list[Checkpoint]) -> Checkpoint:
    """The checkpoint that is found, one for all processes, marked as in use by a run, and added to ``held``."""
    while True:
        found = find()  # by every process, so that each ends when there is none
        chosen = [str(found.folder)]  # where it still trains, others may have found a newer one by now
        if PartialState().is_main_process:
            mark_in_use(found, run)
            there = found.folder.is_dir() and found.base_folder.is_dir()
            chosen = [str(found.folder) if there else ""]  # "": deleted before it was marked
        broadcast_object_list(chosen)
        if chosen[0]:
            held.append(find_checkpoint(Path(chosen[0])))
            return held[-1]


def find_model(text: str, stage: Stage, wanted: str | None) -> Checkpoint:
    """The checkpoint that a recipe names, or where a hash is wanted the one with these weights in the same run.

    Raises:
        CheckpointError: when there is none.
    """
    if wanted is None:
        return named_model(text, stage)[0]
    place, *name = text.split("#")
    for folder in model_folders(checkpoint_folder(Path(place))):
        with contextlib.suppress(CheckpointError):
            checkpoint, adapter = named_model("#".join([str(folder), *name]), stage)
            if weights_hash(checkpoint, adapter) == wanted:
                return checkpoint
    raise CheckpointError(
        f"{text}: the weights that the run began to distil ({wanted[:SHOWN]}) are not there any more; bring them back, "
        "or begin a new run"
    )


def _with_place(recipe: Recipe, key: str, text: str, checkpoint: Checkpoint) -> Recipe:
    """The recipe with a checkpoint of a run in the place of that run."""
    step, name = checkpoint.folder.parent, text.partition("#")[2]
    if not step.name.startswith(STEP) or recipe.distill is None:
        return recipe
    place = f"{step}#{name}" if name else str(step)
    if key == "adapter_from":
        return replace(recipe, adapter_from=place)
    return replace(recipe, distill=replace(recipe.distill, teacher=place))
