"""The features of a scene's cells: their classes; images are not read."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from pydantic import PositiveInt
from torch import Tensor

from persist_cli.api.encoder import Encoder
from persist_cli.errors import CheckpointError


@dataclass(frozen=True)
class ClassesSettings:
    """The length of the features.

    Args:
        classes: largest number of classes; the palette of a scene may be shorter.
    """

    classes: PositiveInt = 32


class Classes(Encoder):
    """One-hot features of classes, in the order of the scene's palette."""

    settings_type = ClassesSettings
    reads_images = False
    settings: ClassesSettings

    @property
    def channels(self) -> int:
        """The number of classes."""
        return self.settings.classes

    def encode(self, rgb: UInt8[Tensor, "frame height width 3"]) -> Float[Tensor, "frame rows columns channel"]:
        """Raise ``CheckpointError``, since images have no classes."""
        raise CheckpointError(
            f"encoder {self.name!r} makes features of the cells of a scene and reads no images; "
            "take another encoder, such as patches, or the memory scene"
        )

    def features(self, classes: UInt8[Tensor, " token"]) -> Float[Tensor, "token channel"]:
        """Return the features of cells of these classes."""
        return torch.nn.functional.one_hot(classes.long(), self.channels).float()
