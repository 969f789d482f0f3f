"""The folder of a run: its recipe, its logs and its checkpoints."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from safetensors import SafetensorError

from persist_cli.api.checkpoint import Checkpoint, step_folders
from persist_cli.api.training_scenes import TrainingScenes
from persist_cli.checkpoints.lineage import RECIPE, Lineage, stage_recipes, training_scenes
from persist_cli.checkpoints.retention import KeptCheckpoint, ended_recipe, kept_checkpoints, remove_superseded
from persist_cli.errors import PersistError
from persist_cli.io.files import remove_leftovers, write_text
from persist_cli.io.sha256sums import rewrite_files
from persist_cli.recipe import Recipe, to_yaml
from persist_cli.train.log import SpeedLog, StepLog
from persist_cli.train.sources import named_model, with_own_adapter, write_hashes
from persist_cli.train.state import save_state
from persist_cli.train.training_loop import TrainingLoop


def source_scenes(recipe: Recipe) -> TrainingScenes:
    """The scenes of the adapter that is trained on and of the teacher, which the model learns of too; none without."""
    teacher = recipe.distill.teacher if recipe.distill else None
    scenes = TrainingScenes()
    for text in filter(None, (recipe.adapter_from, teacher)):
        scenes |= training_scenes(named_model(text, recipe.stage)[0])
    return scenes


def lineage_of(trainer: TrainingLoop[Any], recipe: Recipe, base: Checkpoint) -> Lineage:
    """Where the model comes from that a trainer trains on a base; the recipe names the adapter that it goes on with."""
    scenes = trainer.scenes | training_scenes(base) | source_scenes(recipe)
    return Lineage(scenes, base, stage_recipes(base.base_folder) if recipe.memory is None else {})


class RunFolder:
    """Writes the files of a run: the main process alone, or all processes where the training is sharded.

    Args:
        path: the folder; it is made when missing.
        trainer: the run's trainer, in the state of the folder's newest checkpoint where there is one.
        base: the checkpoint that the run starts from. Its scenes and the recipes of its stages are read now, because
            the runs behind it may be removed later.
    """

    def __init__(self, path: Path, trainer: TrainingLoop[Any], base: Checkpoint | None) -> None:
        self.path, self.trainer, self.saved = path, trainer, trainer.state.step
        self.lineage = Lineage(trainer.scenes, base)
        self.log: StepLog | None = None  # the main process's alone, as no two may rewrite it
        if trainer.accelerator.is_main_process:
            remove_leftovers(path)
            if base is not None:
                self.lineage = lineage_of(trainer, with_own_adapter(trainer.recipe, path), base)
            path.mkdir(parents=True, exist_ok=True)
            write_text(path / RECIPE, to_yaml(trainer.recipe))
            write_hashes(trainer.recipe, path)
            self.log = StepLog(path / "log.jsonl", self.saved)
        trainer.accelerator.wait_for_everyone()  # the folder is there now
        self.speed = SpeedLog(path / "speed.jsonl", self.saved, trainer.recipe.training.batch)

    def save(self) -> None:
        """Write a checkpoint of the current step, unless it is written already.

        Raises:
            PersistError: when it cannot be written.
        """
        step = self.trainer.state.step
        if step == self.saved:
            return
        try:
            save_state(self.path, self.trainer.state, self._save_model)
        except (OSError, SafetensorError) as error:  # a backbone may write with safetensors itself
            raise PersistError(f"{self.path}: a checkpoint cannot be written there ({error})") from error
        if self.log is not None:
            self._follow(self.log)
        self.trainer.accelerator.wait_for_everyone()
        self.saved = step

    def finish(self) -> list[KeptCheckpoint]:
        """Write a checkpoint of the last step and return the checkpoints that are kept, the newest last.

        A run that is resumed for just the steps that it has taken ends its recipe with the checkpoint that is there,
        which then gets this recipe.
        """
        self.save()
        recipe = self.trainer.recipe
        step, newest = self.trainer.state.step, recipe.training.keep_checkpoints
        if self.trainer.accelerator.is_main_process:
            last = step_folders(self.path)[-1]
            if step == recipe.training.steps and not ended_recipe(last):
                rewrite_files({last / "model": {RECIPE: to_yaml(recipe)}})
            remove_superseded(self.path, newest)
        return kept_checkpoints(self.path, newest)

    def _follow(self, log: StepLog) -> None:
        """Do what follows a checkpoint, which is whole by now: log the speed, remove older ones, draw the loss."""
        trainer = self.trainer
        self.speed.add(trainer.state.step, trainer.figures())
        remove_superseded(self.path, trainer.recipe.training.keep_checkpoints)
        log.draw(self.path / "loss.png")

    def _save_model(self, folder: Path, home: Path) -> None:
        trainer = self.trainer
        with trainer.model_to_save() as model:
            if trainer.accelerator.is_main_process:
                folder.mkdir()
                write_text(folder / RECIPE, to_yaml(trainer.recipe))
                trainer.write_model(model, folder, home, self.lineage)
