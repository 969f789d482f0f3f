"""diffusers' CPU offload for a backbone's parts; importing it executes all of diffusers' pipelines."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from diffusers import AutoencoderKLCogVideoX, CogVideoXTransformer3DModel, DiffusionPipeline
from diffusers.models.modeling_utils import ModelMixin
from torch import nn


class OffloadingPipeline(DiffusionPipeline):  # type: ignore[misc]
    """diffusers' CPU offload for a world model, which also moves the modules between the transformer's blocks."""

    model_cpu_offload_seq = "transformer->vae"

    def enable_sequential_cpu_offload(self, gpu_id: int | None = None, device: Any = None) -> None:
        """Keep each layer of each component on the accelerator only while it runs, as in diffusers."""
        self._exclude_from_cpu_offload: list[str] = []
        super().enable_sequential_cpu_offload(gpu_id, device)

    def enable_model_cpu_offload(self, gpu_id: int | None = None, device: Any = None) -> None:
        """Keep each whole component on the accelerator only while it runs; ``world`` and ``adapter`` stay there."""
        self._exclude_from_cpu_offload = ["world", "adapter"]
        super().enable_model_cpu_offload(gpu_id, device)


class OffloadedModule(ModelMixin):  # type: ignore[misc]
    """Modules of the backbone, shared with it, as a model that diffusers can offload.

    Args:
        modules: the modules by name.
    """

    def __init__(self, modules: Mapping[str, nn.Module]) -> None:
        super().__init__()
        for name, module in modules.items():
            self.add_module(name, module)


class OffloadedParts(OffloadingPipeline):
    """The parts of an offloaded backbone; this pipeline only moves them, sampling is done by the backbone.

    Args:
        transformer: diffusers' transformer.
        vae: diffusers' VAE.
        world: the modules that widen the transformer, with the prompt's embedding.
        adapter: the memory adapter, if one is in use.
    """

    _optional_components: ClassVar = ["adapter"]

    def __init__(
        self,
        transformer: CogVideoXTransformer3DModel,
        vae: AutoencoderKLCogVideoX,
        world: OffloadedModule,
        adapter: OffloadedModule | None,
    ) -> None:
        super().__init__()
        self.register_modules(transformer=transformer, vae=vae, world=world, adapter=adapter)
