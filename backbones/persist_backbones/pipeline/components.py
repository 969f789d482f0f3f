"""The parts of a model besides diffusers' own, as components that diffusers' pipelines can save, load and move."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from diffusers import AutoencoderKLCogVideoX, CogVideoXTransformer3DModel
from diffusers.configuration_utils import ConfigMixin, register_to_config
from diffusers.models.modeling_utils import ModelMixin

from persist_backbones.adapters.base import Adapter, VideoShape
from persist_backbones.adapters.forms import make_adapter
from persist_backbones.cogvideox.cogvideox import CogVideoX
from persist_backbones.cogvideox.config import CogVideoXSettings
from persist_backbones.cogvideox.inputs import clip_shape
from persist_backbones.cogvideox.model import widen
from persist_backbones.cogvideox.parts import DiffusersParts
from persist_backbones.extensions.extended import ExtendedCogVideoX
from persist_cli.api.meta_device import without_weights
from persist_cli.io.settings import parse_settings

BASE = "base"  # diffusers' transformer inside ours, a component of its own


class WorldModules(ModelMixin, ConfigMixin):  # type: ignore[misc]
    """The modules that make diffusers' transformer a world model: widening, interactions and the prompt's embedding.

    Args:
        settings: settings of the backbone, plain values.
        transformer: configuration of diffusers' transformer.
        vae: configuration of the VAE.
    """

    @register_to_config  # type: ignore[untyped-decorator]
    def __init__(self, settings: dict[str, Any], transformer: dict[str, Any], vae: dict[str, Any]) -> None:
        super().__init__()
        with without_weights():
            base = CogVideoXTransformer3DModel.from_config(transformer)
            codec = AutoencoderKLCogVideoX.from_config(vae)
        backbone = self.backbone_settings()
        for name, module in widen(base, codec, backbone, clip_shape(base, codec, backbone)).named_children():
            if name != BASE:
                self.add_module(name, module)
        words = base.config.max_text_seq_length, base.config.text_embed_dim
        self.register_buffer("prompt", torch.zeros(1, *words))

    def backbone_settings(self) -> CogVideoXSettings:
        """Return the settings of the backbone."""
        return parse_settings(CogVideoXSettings, self.config.settings, "world/config.json")

    @staticmethod
    def of(backbone: CogVideoX) -> WorldModules:
        """Return the modules of a backbone, shared with it."""
        configs = (backbone.transformer.base.config, backbone.codec.vae.config)
        plain = [{key: value for key, value in config.items() if not key.startswith("_")} for config in configs]
        with without_weights():  # keys that begin with _ are paths from which the configurations were read
            world = WorldModules(backbone.checkpoint_settings(), *plain)
        for name in dict(world.named_children()):
            setattr(world, name, getattr(backbone.transformer, name))
        world.prompt = backbone.prompt
        return world.train(backbone.training)  # type: ignore[no-any-return]


class MemoryAdapter(ModelMixin, ConfigMixin):  # type: ignore[misc]
    """A memory adapter as a component of diffusers' pipelines.

    Args:
        channels: channels of the features of a memory token.
        settings: settings of the adapter's form, plain values.
        video: the values of ``VideoShape``.
    """

    @register_to_config  # type: ignore[untyped-decorator]
    def __init__(self, channels: int, settings: dict[str, Any], video: dict[str, int]) -> None:
        super().__init__()
        self.adapter = make_adapter(channels, settings, VideoShape(**video), "adapter/config.json")

    @staticmethod
    def of(adapter: Adapter[Any]) -> MemoryAdapter:
        """Return a component of a backbone's adapter, shared with the backbone."""
        with without_weights():
            shape = (dataclasses.asdict(adapter.settings), dataclasses.asdict(adapter.video))
            component = MemoryAdapter(adapter.channels, *shape)
        component.adapter = adapter
        return component.train(adapter.training)  # type: ignore[no-any-return]


def assemble(parts: DiffusersParts, world: WorldModules, memory: MemoryAdapter | None) -> ExtendedCogVideoX:
    """Build a backbone that shares these components.

    Raises:
        CheckpointError: when the components do not fit each other.
    """
    with without_weights():
        backbone = ExtendedCogVideoX(world.backbone_settings())
    backbone.name = "cogvideox"
    backbone.set_parts(parts)
    for name, module in world.named_children():
        setattr(backbone.transformer, name, module)
    backbone.prompt = world.prompt
    if memory is not None:
        backbone.adapters["adapter"], backbone.adapter_name = memory.adapter, "adapter"
    return backbone.eval()
