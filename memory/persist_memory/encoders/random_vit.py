"""Features of a vision transformer with random weights: a control, which tells what training of an encoder gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from persist_memory.encoders.dinov2 import IMAGENET_MEAN, IMAGENET_STD
from persist_memory.encoders.vision_transformer import TransformerSettings, VisionTransformer

WIDTH, BLOCKS, HEADS = 384, 12, 6  # those of ViT-S


@dataclass(frozen=True, kw_only=True)
class RandomVitSettings(TransformerSettings):
    """The seed of the weights.

    Args:
        seed: seed of the weights. One seed gives the same weights with the same version of torch and transformers.
    """

    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0


class RandomVit(VisionTransformer):
    """Features of a DINOv2 ViT-S/14 that was never trained: a control, no substitute for missing weights."""

    settings_type = RandomVitSettings
    settings: RandomVitSettings
    mean, deviation = IMAGENET_MEAN, IMAGENET_STD

    @property
    def source(self) -> str:
        """The name of the control."""
        return self.name

    def load_config(self) -> Any:
        """Return the configuration of DINOv2 ViT-S/14."""
        from transformers import Dinov2Config

        return Dinov2Config(
            hidden_size=WIDTH, num_hidden_layers=BLOCKS, num_attention_heads=HEADS, image_size=518, patch_size=14
        )

    def load_model(self) -> Any:
        """Return the network with the seed's weights, up to the settings' block."""
        from transformers import Dinov2Model

        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.settings.seed)
            model = Dinov2Model(self.config)
        del model.encoder.layer[self.settings.layer or len(model.encoder.layer) :]
        return model

    def patch_states(self, pixels: Float[Tensor, "frame 3 height width"]) -> Float[Tensor, "frame token channel"]:
        """Return class and patch tokens after the layer norm."""
        states: Tensor = self.model(pixels).last_hidden_state
        return states
