"""The features of a scene's cells: their class and which surface along the ray they are; images are not read."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64, UInt8
from pydantic import PositiveInt
from torch import Tensor

from persist_cli.api.encoder import Encoder
from persist_cli.errors import CheckpointError


@dataclass(frozen=True)
class ClassesSettings:
    """The length of the features.

    Args:
        classes: largest number of classes; the palette of a scene may be shorter.
        layers: largest number of surfaces along a ray.
    """

    classes: PositiveInt = 32
    layers: PositiveInt = 4


class Classes(Encoder):
    """One-hot features: first the class of a cell, then the layer of the surface, 0 for the nearest along its ray."""

    settings_type = ClassesSettings
    settings: ClassesSettings

    @property
    def channels(self) -> int:
        """The number of classes and layers."""
        return self.settings.classes + self.settings.layers

    def encode(self, rgb: UInt8[Tensor, "frame height width 3"]) -> Float[Tensor, "frame rows columns channel"]:
        """Raise ``CheckpointError``, since images have no classes."""
        raise CheckpointError(
            f"encoder {self.name!r} makes features of the cells of a scene and reads no images; "
            "take another encoder, such as patches, or the memory scene"
        )

    def features(
        self, classes: UInt8[Tensor, " token"], layers: Int64[Tensor, " token"]
    ) -> Float[Tensor, "token channel"]:
        """Return the features of surfaces.

        Args:
            classes: class of each surface's cell.
            layers: which surface along its ray it is, from 0.
        """
        features = torch.zeros(len(classes), self.channels, device=classes.device)
        rows = torch.arange(len(classes), device=classes.device)
        features[rows, classes.long()] = 1.0
        features[rows, self.settings.classes + layers] = 1.0
        return features
