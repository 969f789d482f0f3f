"""What is ours of a model as diffusers' pipelines keep it: components that save, load and move as its own do."""

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
from persist_cli.io.settings import parse_settings

BASE = "base"  # diffusers' transformer inside ours, a component of its own


class WorldModules(ModelMixin, ConfigMixin):  # type: ignore[misc]
    """What makes diffusers' transformer a world model: widening, interactions and the prompt's embedding.

    Args:
        settings: of the backbone, plain values.
        transformer: configuration of diffusers' transformer.
        vae: configuration of the VAE.
    """

    @register_to_config  # type: ignore[untyped-decorator]
    def __init__(self, settings: dict[str, Any], transformer: dict[str, Any], vae: dict[str, Any]) -> None:
        super().__init__()
        with torch.device("meta"):
            theirs = CogVideoXTransformer3DModel.from_config(transformer)
            codec = AutoencoderKLCogVideoX.from_config(vae)
        own = self.backbone_settings()
        for name, module in widen(theirs, codec, own, clip_shape(theirs, codec, own)).named_children():
            if name != BASE:
                self.add_module(name, module)
        words = theirs.config.max_text_seq_length, theirs.config.text_embed_dim
        self.register_buffer("prompt", torch.zeros(1, *words))

    def backbone_settings(self) -> CogVideoXSettings:
        """The settings of the backbone."""
        return parse_settings(CogVideoXSettings, self.config.settings, "world/config.json")

    @staticmethod
    def of(backbone: CogVideoX) -> WorldModules:
        """The modules of a backbone, shared with it."""
        theirs = (backbone.transformer.base.config, backbone.codec.vae.config)
        plain = [{key: each for key, each in config.items() if not key.startswith("_")} for config in theirs]
        with torch.device("meta"):  # what begins with _ is where they were read, as a path
            made = WorldModules(backbone.checkpoint_settings(), *plain)
        for name in dict(made.named_children()):
            setattr(made, name, getattr(backbone.transformer, name))
        made.prompt = backbone.prompt
        return made.train(backbone.training)  # type: ignore[no-any-return]


class MemoryAdapter(ModelMixin, ConfigMixin):  # type: ignore[misc]
    """A memory adapter.

    Args:
        channels: of the memory's features.
        settings: of the adapter's form, plain values.
        video: what ``VideoShape`` holds.
    """

    @register_to_config  # type: ignore[untyped-decorator]
    def __init__(self, channels: int, settings: dict[str, Any], video: dict[str, int]) -> None:
        super().__init__()
        self.adapter = make_adapter(channels, settings, VideoShape(**video), "adapter/config.json")

    @staticmethod
    def of(adapter: Adapter[Any]) -> MemoryAdapter:
        """An adapter, shared with its backbone."""
        with torch.device("meta"):
            shape = (dataclasses.asdict(adapter.settings), dataclasses.asdict(adapter.video))
            made = MemoryAdapter(adapter.channels, *shape)
        made.adapter = adapter
        return made.train(adapter.training)  # type: ignore[no-any-return]


def assemble(parts: DiffusersParts, world: WorldModules, memory: MemoryAdapter | None) -> ExtendedCogVideoX:
    """The backbone made of these components, which it shares.

    Raises:
        CheckpointError: when they do not fit together.
    """
    with torch.device("meta"):
        backbone = ExtendedCogVideoX(world.backbone_settings())
    backbone.name = "cogvideox"
    backbone.set_parts(parts)
    for name, module in world.named_children():
        setattr(backbone.transformer, name, module)
    backbone.prompt = world.prompt
    if memory is not None:
        backbone.adapters["adapter"], backbone.adapter_name = memory.adapter, "adapter"
    return backbone.eval()
