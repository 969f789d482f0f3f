"""A memory that keeps the frame seen last; an example of a plugin of persist."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from pydantic import PositiveInt
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.encoder import Encoder
from persist_cli.api.memory import FrameOfReference, Memory
from persist_cli.api.observations import Observations
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import CheckpointError

TENSORS = {"features", "center", "origin"}


@dataclass(frozen=True)
class LastFrameSettings:
    """What a recipe may set under ``memory.settings``; unknown and wrong values are refused by name.

    Args:
        most: the greatest number of tokens that one read gives.
    """

    most: PositiveInt = 64


class LastFrame(Memory):
    """The features of the frame seen last, each at the place of the camera that saw it."""

    settings_type = LastFrameSettings
    settings: LastFrameSettings

    def __init__(self, settings: LastFrameSettings, encoder: Encoder, reference: FrameOfReference) -> None:
        super().__init__(settings, encoder, reference)
        self.clear()

    def write(self, observations: Observations) -> None:
        """Keep the last of the frames; one that a model imagined never replaces one that was observed."""
        origin, frames = observations.by_origin()[0]  # the observed ones, if there are any
        if origin < self._origin:
            return
        features = self.encoder.encoded(frames.rgb[-1:])  # [1, rows, columns, channel]
        self._features = features[0].flatten(0, 1)
        self._center = frames.cameras.centers[-1:].double()
        self._origin = frames.origins[-1:]

    def read(self, cameras: Cameras, budget: int) -> MemoryTokens:
        """Return the first tokens of the frame, whatever the cameras."""
        features = self._features[: min(budget, self.settings.most)]
        return MemoryTokens.of(features, self._center.expand(len(features), 3))

    def tensors(self) -> dict[str, Tensor]:
        """Return features, camera centre and origin of the frame; nothing when no frame was seen."""
        if not len(self._features):
            return {}
        return {"features": self._features, "center": self._center, "origin": self._origin}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Take what ``tensors`` returned.

        Raises:
            CheckpointError: when they are not those of this memory.
        """
        if tensors and set(tensors) != TENSORS:
            wanted = ", ".join(sorted(TENSORS))
            raise CheckpointError(f"memory {self.name!r}: holds {', '.join(sorted(tensors))}, wanted are {wanted}")
        self._features = tensors.get("features", torch.zeros(0, self.encoder.channels))
        self._center = tensors.get("center", torch.zeros(1, 3, dtype=torch.float64))
        self._origin = tensors.get("origin", torch.zeros(1, dtype=torch.uint8))
