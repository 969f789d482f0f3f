"""Settings of a walk with the keys, and what is shown of each of its frames."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from jaxtyping import Float, UInt8
from torch import Tensor

from persist_cli.api.ground import ground_axes
from persist_cli.api.inference import Sampling
from persist_cli.errors import PersistError

Picture = UInt8[Tensor, "height width 3"]


GROWTH: Final = (2, 3, 5)  # frames of the first clips under newly held keys, the present one included


@dataclass(frozen=True, kw_only=True)
class PlaySettings:
    """How frames are imagined while somebody walks.

    Fewer steps answer a key sooner; each guidance takes another prediction a step.

    Args:
        steps: denoising steps of a clip, at least 1.
        guidance: weight of guidance over memory, at least 0; 1 means none.
        autoguidance: weight of guidance away from the checkpoint's guide, at least 1; 1 means none.
        seed: of the sampling noise.
        ahead: whether the likely next actions are imagined while no key is held. Where ``growing`` makes clips shorter,
            pictures differ somewhat by whether there was time for that.
        clip_frames: frames of a clip, the present one included; ``None`` for as many as in training. Short clips answer
            a key sooner and take more time a frame.
        growing: whether the first clips under newly held keys are shorter, as ``GROWTH`` says, where the model can make
            such clips. A key is then answered sooner, and those after it show as many frames for their time as before.
    """

    steps: int = 1
    guidance: float = 1.0
    autoguidance: float = 1.0
    seed: int = 0
    ahead: bool = True
    clip_frames: int | None = None
    growing: bool = True

    def __post_init__(self) -> None:
        Sampling(self.steps, memory_guidance=self.guidance, autoguidance=self.autoguidance).check()
        if self.seed < 0:
            raise PersistError(f"seed {self.seed}; it must be at least 0")


@dataclass(frozen=True)
class GroundPose:
    """Where the agent stands on the ground, and where it looks.

    Args:
        x: metres along the first ground axis, to the right in a map.
        y: metres along the second, upward in a map.
        degrees: of the heading, to the left of the first axis, -180 to 180.
    """

    x: float
    y: float
    degrees: float

    @staticmethod
    def of(world_from_camera: Float[Tensor, "4 4"], world_up: tuple[float, float, float]) -> GroundPose:
        """Return the place and heading of a camera."""
        axes, pose = ground_axes(world_up), world_from_camera.cpu().double()
        (x, y), (ahead, left) = (axes[:2] @ pose[:3, 3]).tolist(), (axes[:2] @ pose[:3, 2]).tolist()
        return GroundPose(x, y, math.degrees(math.atan2(left, ahead)))


@dataclass(frozen=True)
class Shown:
    """A frame that is shown.

    Args:
        number: counts up by one from frame to frame, also after ``undo`` and ``reset``; the first is 0.
        action: that led here; ``None`` where none did, as at the start and after a jump.
        free: whether its way was free; a blocked action shows the frame before it once more.
        pose: where the agent stands.
        images: uint8, 0…255, by the name of the memory.
        milliseconds: that it took to be there.
    """

    number: int
    action: str | None
    free: bool
    pose: GroundPose
    images: Mapping[str, Picture]
    milliseconds: float
