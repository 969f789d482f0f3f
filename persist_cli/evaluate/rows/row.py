"""The abstract row."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Literal

from torch import Tensor

from persist_cli.api.backbone import Backbone
from persist_cli.api.inference import InferenceOptions
from persist_cli.checkpoints.checkpoint import Checkpoint
from persist_cli.evaluate.cases import CaseFrames

Kind = Literal["model", "control", "memory control"]


class Row(ABC):
    """What one line of the table gives for a clip.

    ``random`` says whether another sampling seed gives another result, ``gives_depth`` whether its depth is one.

    Args:
        name: in the table.
        base: the checkpoint whose backbone it needs.
    """

    kind: Kind = "control"
    random: ClassVar[bool] = False
    gives_depth: bool = True

    def __init__(self, name: str, base: Checkpoint) -> None:
        self.name, self.base = name, base

    @property
    @abstractmethod
    def definition(self) -> str:
        """What the row shows, in a few words."""

    def prepare(self, backbone: Backbone, placement: InferenceOptions) -> None:
        """Make the backbone ready for this row, placed like this."""
        backbone.prepare_inference(placement)

    @abstractmethod
    def videos(self, backbone: Backbone, clips: Sequence[CaseFrames], seeds: Sequence[int]) -> tuple[Tensor, Tensor]:
        """RGB uint8 ``[clip, frame, height, width, 3]`` and depth in metres of every frame, the given one first.

        Args:
            backbone: prepared for this row.
            clips: all of one number of frames.
            seeds: of the sampling noise, one for each clip.
        """
