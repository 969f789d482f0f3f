"""DINOv2 patch features (PEWM, memory), from fetched weights, a local directory or the hub."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor

from persist_memory.encoders.vision_transformer import PublishedSettings, PublishedTransformer

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


@dataclass(frozen=True, kw_only=True)
class DinoV2Settings(PublishedSettings):
    """The weights and the block of the network that give the features.

    Args:
        weights: a directory that transformers wrote (``config.json`` and ``model.safetensors``); the name of weights
            that ``persist weights fetch`` brought (``dinov2-small``, ``dinov2-base``, ``dinov2-s-derived``); or a hub
            id, which is downloaded when it is not in the hub's cache. Missing weights are never replaced by others.
            DINOv2-S-derived was tuned for another task in its last blocks: take its block 8.
    """

    weights: str = "dinov2-small"


class DinoV2(PublishedTransformer):
    """Features of a frozen DINOv2; its files are opened when first needed."""

    settings_type = DinoV2Settings
    settings: DinoV2Settings
    title = "DINOv2"
    mean, deviation = IMAGENET_MEAN, IMAGENET_STD
    widths = {"dinov2-small": 384, "dinov2-base": 768, "dinov2-s-derived": 384}  # noqa: RUF012  (a ClassVar above)
    publisher = "facebook/"

    def load_config(self) -> Any:
        """Return the configuration beside the weights."""
        from transformers import Dinov2Config

        return self.from_pretrained(Dinov2Config)

    def load_model(self) -> Any:
        """Return the network up to the settings' block."""
        from transformers import Dinov2Model

        model = self.load_weights(Dinov2Model)
        del model.encoder.layer[self.settings.layer or len(model.encoder.layer) :]  # their output is not used
        return model

    def patch_states(self, pixels: Float[Tensor, "frame 3 height width"]) -> Float[Tensor, "frame token channel"]:
        """Return class, register and patch tokens after the layer norm."""
        states: Tensor = self.model(pixels).last_hidden_state
        return states
