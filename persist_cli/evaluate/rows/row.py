"""The abstract row: one line of the table, which makes a video for each clip."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, Literal

from jaxtyping import Float, Int64
from torch import Tensor

from persist_cli.api.backbone import Backbone
from persist_cli.api.checkpoint import Checkpoint
from persist_cli.api.inference import InferenceOptions
from persist_cli.api.observations import TrajectoryInfo
from persist_cli.evaluate.cases import CaseFrames

RowKind = Literal["model", "control", "memory control"]


class Row(ABC):
    """One line of the table: a model or a control that makes a video for each clip.

    ``random`` says whether another sampling seed gives another video, ``uses_model`` whether the base's model makes
    the videos, and ``adapter`` which of its memory adapters reads a memory for that.

    Args:
        name: name among all rows that are measured.
        base: checkpoint whose backbone the row needs.
        group: name in the table, where rows of one group are one row of several training seeds; ``None`` for its name.
    """

    kind: RowKind = "control"
    random: ClassVar[bool] = False
    uses_model: ClassVar[bool] = False
    adapter: str | None = None
    has_depth: bool = True  # whether the base's model, where it makes the videos, takes depth and gives it

    def __init__(self, name: str, base: Checkpoint, group: str | None = None) -> None:
        self.name, self.base, self.group = name, base, group or name

    @property
    def truth(self) -> str:
        """What of the truth it is given, beside the given first frame and the cameras of the clip."""
        return "nothing but the given first frame"

    @property
    @abstractmethod
    def definition(self) -> str:
        """A few words that say what the row shows."""

    def memory_json(self, info: TrajectoryInfo) -> dict[str, Any] | None:
        """What the row's memory stores of such a trajectory, as JSON values; ``None`` without a memory."""
        return None

    def reads(self) -> Float[Tensor, "clip 2"] | None:
        """Tokens and bytes that were read from memory for a generated clip, of each clip of the last ``videos``."""
        return None

    def cells(self) -> Int64[Tensor, "clip step"] | None:
        """Cells of each clip's memory after every predicted clip of the last ``videos``; ``None`` without any."""
        return None

    def prepare(self, backbone: Backbone, placement: InferenceOptions) -> None:
        """Make the backbone ready for this row, with this device and precision."""
        backbone.prepare_inference(placement)

    @abstractmethod
    def videos(self, backbone: Backbone, clips: Sequence[CaseFrames], seeds: Sequence[int]) -> tuple[Tensor, Tensor]:
        """RGB uint8 ``[clip, frame, height, width, 3]`` and depth in metres of every frame, the given one first.

        Args:
            backbone: backbone that was prepared for this row.
            clips: clips with equally many frames.
            seeds: seed of the sampling noise of each clip.
        """


def unique_bases(checkpoints: Sequence[Checkpoint]) -> list[Checkpoint]:
    """One checkpoint for each base, in order of first appearance."""
    return list({checkpoint.fingerprint: checkpoint for checkpoint in checkpoints}.values())
