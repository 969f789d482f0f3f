"""The abstract encoder, which turns images into the feature maps that memories store."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from persist_cli.api.promises import check_features, kept
from persist_cli.errors import PluginError
from persist_cli.io.settings import NoSettings


class Encoder(ABC):
    """Turns RGB images into coarse grids of features; equal images give equal features.

    Args:
        settings: an instance of ``settings_type``, a dataclass of the recipe's settings.
    """

    settings_type: ClassVar[type] = NoSettings
    reads_images: ClassVar[bool] = True  # otherwise ``encode`` always raises, and a memory makes its features
    costly: ClassVar[bool] = False  # features are kept by frame, since finding them again is quicker than encoding
    name: str = ""  # set by the registry

    def __init__(self, settings: Any) -> None:
        self.settings = settings

    @property
    @abstractmethod
    def channels(self) -> int:
        """The number of feature channels."""

    @property
    def channels_by_name(self) -> int:
        """The number of feature channels for estimates, without loading weights where their name tells it."""
        return self.channels

    @abstractmethod
    def encode(self, rgb: UInt8[Tensor, "frame height width 3"]) -> Float[Tensor, "frame rows columns channel"]:
        """Return float32 features on a grid that covers the image evenly, on the encoder's device."""

    def encoded(self, rgb: UInt8[Tensor, "frame height width 3"]) -> Float[Tensor, "frame rows columns channel"]:
        """Return what ``encode`` does, without gradients and checked. Memories encode by this method.

        Raises:
            PluginError: when it is not what that promises, or the images are changed.
        """
        with torch.no_grad(), kept("encoder", self.name, "encode", rgb=rgb):
            features = self.encode(rgb)
        check_features(features, self.name, self.channels, len(rgb))
        return features

    def placed(self, device: torch.device | str) -> Encoder:
        """Return what ``to`` does, after a check that it is an encoder. Persist moves encoders by this method.

        Raises:
            PluginError: when it is not.
        """
        moved: Any = self.to(device)
        if not isinstance(moved, Encoder):
            raise PluginError(f"encoder {self.name!r}: to gave {type(moved).__name__}; it must return an encoder")
        return moved

    def to(self, device: torch.device | str) -> Encoder:
        """Return the encoder on ``device``; by default, without weights of its own, it stays as it is."""
        return self
