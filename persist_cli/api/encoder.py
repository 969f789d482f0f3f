"""The abstract encoder: images to feature maps, what memories are made of."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from persist_cli.io.settings import NoSettings


class Encoder(ABC):
    """Turns RGB images into a coarse grid of features, the same for the same image.

    Args:
        settings: an instance of ``settings_type``.
    """

    settings_type: ClassVar[type] = NoSettings
    name: str = ""  # set by the registry

    def __init__(self, settings: Any) -> None:
        self.settings = settings

    @property
    @abstractmethod
    def channels(self) -> int:
        """Number of feature channels."""

    @property
    def channels_by_name(self) -> int:
        """The same for a plan, without the weights where their width is known by their name."""
        return self.channels

    @abstractmethod
    def encode(self, rgb: UInt8[Tensor, "frame height width 3"]) -> Float[Tensor, "frame rows columns channel"]:
        """Features on a grid that covers the image evenly, float32."""

    def to(self, device: torch.device | str) -> Encoder:
        """The encoder on ``device``; those without weights of their own stay as they are."""
        return self
