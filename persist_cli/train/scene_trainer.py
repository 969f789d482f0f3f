"""The training of a model of scenes on windows of cells."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

from accelerate import Accelerator

from persist_cli.api.scene_model import SceneModel, SceneSamples
from persist_cli.api.training_scenes import TrainingScenes
from persist_cli.checkpoints.lineage import Lineage
from persist_cli.checkpoints.scene_models import save_scene_model
from persist_cli.data.held_out import trained_scene
from persist_cli.data.reference import data_folder
from persist_cli.data.scene_samples import SampleShares, SceneSampleDataset
from persist_cli.recipe import Recipe
from persist_cli.train.distributed import refuse_sharding
from persist_cli.train.tensor_cache import CacheSettings, TensorCache
from persist_cli.train.training_loop import TrainingLoop

# a codec sees the true cells alone, and samples of a single frame are read fastest
WHOLE_CELLS: Final = SampleShares(frame=1, walk=0, grown=0, interaction=0)

ACTING: Final = SampleShares(frame=0, walk=0, grown=0, interaction=1)  # what becomes of cells by interactions

WINDOWS: Final = 64  # of which the scale of the latents is measured at the end of the codec's stage

SHARES: Final = {"scene-codec": WHOLE_CELLS, "scene-outcome": ACTING}  # of the stages that see some kinds alone


class SceneTrainer(TrainingLoop[SceneModel]):
    """Trains a stage of a model of scenes.

    Args:
        recipe: the run's recipe.
        model: the model, with the weights that the stage begins with.
        scenes: those that these were trained on.
        accelerator: accelerate for this process, which may be one of many.
        cache: where it is kept what a scene knows after some frames; ``None`` keeps the latest in memory.

    Raises:
        PersistError: when there are no samples of the model's form, or the model is to be sharded.
    """

    def __init__(
        self,
        recipe: Recipe,
        model: SceneModel,
        scenes: TrainingScenes,
        accelerator: Accelerator,
        cache: CacheSettings | None = None,
    ) -> None:
        super().__init__(recipe, accelerator)
        folders = [data_folder(path) for path in recipe.data.path]
        kept = None if cache is None else TensorCache(cache)
        samples = SceneSampleDataset(folders, model.form, recipe.training.seed, SHARES.get(recipe.stage), kept)
        if recipe.stage == "scene-outcome":
            samples.check_interactions()
        self.dataset = samples
        self.scenes = scenes | TrainingScenes(frozenset(trained_scene(file.info) for file in samples.files))
        self.prepare(model, model.trained_parameters(recipe.stage))

    def make_sharding(self) -> None:
        """None: a model of scenes is not sharded.

        Raises:
            PersistError: when the launcher asks for sharding.
        """
        refuse_sharding(self.accelerator, "a model of scenes is")

    def write_model(self, model: SceneModel, folder: Path, home: Path, lineage: Lineage) -> None:
        """Measure what the stage ends with, and write the parts that are trained so far and a card."""
        batches = self.first_batches(math.ceil(WINDOWS / self.recipe.training.batch))
        model.finish_stage(self.recipe.stage, batches)
        save_scene_model(model, self.recipe.stage, folder, lineage.scenes)

    def to_batch(self, samples: list[Any]) -> SceneSamples:
        """Make a batch of samples on the device."""
        return SceneSamples.stack(samples).to(self.accelerator.device)
