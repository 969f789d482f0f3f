"""The training of a policy's network on samples of trajectories."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from accelerate import Accelerator

from persist_cli.api.policy_network import PolicyNetwork, PolicySamples
from persist_cli.api.training_scenes import TrainingScenes
from persist_cli.checkpoints.lineage import Lineage
from persist_cli.data.held_out import trained_scene
from persist_cli.data.policy_samples import PolicySampleDataset
from persist_cli.data.reference import data_folder
from persist_cli.policies.trained import save_policy
from persist_cli.recipe import Recipe
from persist_cli.train.distributed import refuse_sharding
from persist_cli.train.training_loop import TrainingLoop


class PolicyTrainer(TrainingLoop[PolicyNetwork]):
    """Trains the network of a policy.

    Args:
        recipe: the run's recipe.
        network: the network, with the weights that the training begins with.
        scenes: those that these were trained on.
        accelerator: accelerate for this process, which may be one of many.

    Raises:
        PersistError: when there are no samples, or the network is to be sharded.
    """

    def __init__(
        self, recipe: Recipe, network: PolicyNetwork, scenes: TrainingScenes, accelerator: Accelerator
    ) -> None:
        super().__init__(recipe, accelerator)
        folders = [data_folder(path) for path in recipe.data.path]
        data, form = recipe.data, network.sample_form
        samples = PolicySampleDataset(folders, form, recipe.training.seed, data.mirror, data.detour)
        self.dataset = samples
        self.scenes = scenes | TrainingScenes(frozenset(trained_scene(file.info) for file in samples.files))
        self.prepare(network, network.trained_parameters())

    def make_sharding(self) -> None:
        """None: a policy is small.

        Raises:
            PersistError: when the launcher asks for sharding.
        """
        refuse_sharding(self.accelerator, "a policy's network is small and")

    def write_model(self, model: PolicyNetwork, folder: Path, home: Path, lineage: Lineage) -> None:
        """Write the network and its card."""
        assert self.recipe.policy is not None
        save_policy(model, self.recipe.policy.name, folder, lineage.scenes)

    def to_batch(self, samples: list[Any]) -> PolicySamples:
        """Make a batch of samples on the device."""
        return PolicySamples.stack(samples).to(self.accelerator.device)
