"""Makes empty memories of a configuration, and adds memory tokens to training clips."""

from __future__ import annotations

import dataclasses
import json
from collections import OrderedDict
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from persist_cli.api.backbone import Clip
from persist_cli.api.checkpoint import Checkpoint
from persist_cli.api.encoder import Encoder
from persist_cli.api.memory import FrameOfReference, Memory
from persist_cli.api.observations import TrajectoryInfo
from persist_cli.api.scene import Scene
from persist_cli.checkpoints.load import adapter_memory
from persist_cli.data.clips import ClipSample
from persist_cli.errors import PersistError, RecipeError
from persist_cli.memorize.imagining import with_scene_model
from persist_cli.memorize.kept_features import KeptFeatures
from persist_cli.plugins import load_plugin, make_encoder, make_settings
from persist_cli.recipe import MemoryConfig

if TYPE_CHECKING:
    import torch


MOST_KEPT: Final = 2  # costly encoders that are kept with their features

_KEPT: OrderedDict[str, KeptFeatures] = OrderedDict()  # by name, settings and device


@dataclass(frozen=True)
class MemoryFactory:
    """Makes empty memories of one configuration; plugin, settings and encoder are loaded once.

    Args:
        kind: class of the memories.
        settings: an instance of the class's settings type.
        encoder: the encoder that all memories share; a costly one keeps the features of frames.
        device: device on which encoder and memories compute.
    """

    kind: type[Memory]
    settings: Any
    encoder: Encoder
    device: torch.device | str = "cpu"

    @staticmethod
    def of(config: MemoryConfig, device: torch.device | str = "cpu") -> MemoryFactory:
        """Return the factory of a configuration, whose encoder and memories compute on ``device``."""
        kind = load_plugin("memory", config.name)
        settings = make_settings("memory", config.name, config.settings)
        encoder = make_encoder(config.encoder, config.encoder_settings)
        if encoder.costly:
            key = json.dumps([config.encoder, dataclasses.asdict(encoder.settings), str(device)], default=str)
            encoder = _KEPT.setdefault(key, KeptFeatures(encoder))  # memories of one process share weights and features
            _KEPT.move_to_end(key)
            while len(_KEPT) > MOST_KEPT:
                _KEPT.popitem(last=False)
        return MemoryFactory(kind, settings, encoder.placed(device), device)

    @staticmethod
    def of_adapter(checkpoint: Checkpoint, adapter: str, device: torch.device | str = "cpu") -> MemoryFactory:
        """Return the factory of the memory that an adapter of a checkpoint reads, computing on ``device``.

        Raises:
            PersistError: naming the adapter, when its plugins are not installed or now have other settings.
        """
        config = adapter_memory(checkpoint, adapter)
        try:
            return MemoryFactory.of(config, device)
        except PersistError as error:
            raise type(error)(f"adapter {adapter!r} of {checkpoint.folder}: {error}") from error

    def empty(self, info: TrajectoryInfo) -> Memory:
        """Return an empty memory in the world of a trajectory."""
        return with_scene_model(self.kind(self.settings, self.encoder, FrameOfReference(info.scene, info.world_up)))


def memory_of(sample: ClipSample, factory: MemoryFactory) -> Memory:
    """Return a memory of a sample's context, or of what stands in its place: a kept memory, or true cells."""
    memory = factory.empty(sample.info)
    if sample.remembered is not None:
        memory.restore({name: tensor.to(factory.device) for name, tensor in sample.remembered.items()})
    elif sample.context is not None:
        memory.memorize(sample.context.to(factory.device))
    elif sample.cells is not None:
        as_scene(memory).add(sample.cells)
    return memory


def as_scene(memory: Memory) -> Scene:
    """Return the memory, which must be a scene.

    Raises:
        RecipeError: one line when it is not, and so takes no cells.
    """
    if not isinstance(memory, Scene):
        raise RecipeError(f"memory {memory.name!r} takes no true cells; use the memory scene, or data.true_cells=0")
    return memory


def with_memory(sample: ClipSample, factory: MemoryFactory | None, budget: int) -> Clip:
    """Return a training clip with at most ``budget`` tokens of a memory of its context; none without a factory."""
    if factory is None:
        return sample.clip
    memory, cameras = memory_of(sample, factory), sample.clip.observations.cameras
    memory.foresee([cameras])
    return replace(sample.clip, tokens=memory.recall([cameras], budget)[0].to(factory.device))
