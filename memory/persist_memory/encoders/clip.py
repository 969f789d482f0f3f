"""CLIP patch features (an ablation of PEWM), from fetched weights, a local directory or the hub."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor

from persist_memory.encoders.vision_transformer import PublishedSettings, PublishedTransformer

CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)


@dataclass(frozen=True, kw_only=True)
class ClipSettings(PublishedSettings):
    """The weights and the block of CLIP's vision transformer that give the features.

    Args:
        weights: a directory that transformers wrote (``config.json`` and ``model.safetensors``, of CLIP or of its
            vision model alone); the name of weights that ``persist weights fetch`` brought
            (``clip-vit-large-patch14``); or a hub id, which is downloaded when it is not in the hub's cache. Missing
            weights are never replaced by others.
    """

    weights: str = "clip-vit-large-patch14"


class Clip(PublishedTransformer):
    """Patch features of CLIP's frozen vision transformer, before the projection into the space of texts."""

    settings_type = ClipSettings
    settings: ClipSettings
    title = "CLIP"
    mean, deviation = CLIP_MEAN, CLIP_STD
    widths = {"clip-vit-large-patch14": 1024, "clip-vit-base-patch16": 768, "clip-vit-base-patch32": 768}  # noqa: RUF012
    publisher = "openai/"

    def load_config(self) -> Any:
        """Return the vision model's configuration beside the weights."""
        from transformers import CLIPVisionConfig

        return self.from_pretrained(CLIPVisionConfig)

    def load_model(self) -> Any:
        """Return the network up to the settings' block."""
        from transformers import CLIPVisionModel
        from transformers.utils import logging

        before = logging.get_verbosity()
        logging.set_verbosity_error()  # else it lists the weights of the text model, which are left unread
        try:
            model = self.load_weights(CLIPVisionModel)
        finally:
            logging.set_verbosity(before)
        layers = getattr(model, "vision_model", model).encoder.layers
        del layers[self.settings.layer or len(layers) :]  # their output is not used
        return model

    def patch_states(self, pixels: Float[Tensor, "frame 3 height width"]) -> Float[Tensor, "frame token channel"]:
        """Return class and patch tokens; CLIP has a layer norm before its blocks, and none for patches after them."""
        states: Tensor = self.model(pixels, interpolate_pos_encoding=True).last_hidden_state
        return states
