"""Costs of goals that are images: how unlike the goal image a frame looks, by features of a network.

All frames of all candidates go through the network together; the goal's features are computed once and kept.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, UInt8
from pydantic import PositiveInt
from torch import Tensor

from persist_cli.api.cost import Cost, Futures
from persist_cli.api.ground import GroundMap
from persist_cli.api.policy import Goal
from persist_cli.errors import PersistError
from persist_cli.metrics import dreamsim, lpips
from persist_cli.metrics.networks import exact_inference, missing_weights, network_device, network_weights, run_network
from persist_cli.metrics.src import ENCODERS, encode_frames

Frames = UInt8[Tensor, "frame height width 3"]


class ImageCost(Cost):
    """A cost that compares frames with the goal image.

    Args:
        settings: an instance of ``settings_type``.
    """

    reads = "image"

    def __init__(self, settings: Any) -> None:
        super().__init__(settings)
        self._goal: tuple[Tensor, Any] | None = None  # the last goal image, and its features

    def measure(self, futures: Futures, goal: Goal, ground: GroundMap) -> Float[Tensor, "candidate frame"]:
        """Return how unlike the goal image each frame looks, 0 for a copy.

        Raises:
            PersistError: when the goal has no image, one of another size, or one too small for the network.
        """
        candidates, frames = futures.rgb.shape[:2]
        if goal.rgb is None:
            raise PersistError(f"cost {self.name!r} compares images, and the goal is a place; give an image as goal")
        if goal.rgb.shape != futures.rgb.shape[2:]:
            (height, width), (high, wide) = goal.rgb.shape[:2], futures.rgb.shape[2:4]
            raise PersistError(f"the goal image has {width}×{height} pixels, frames have {wide}×{high}; resize it")
        costs = self.compare(futures.rgb.flatten(0, 1).cpu(), self.goal_features(goal.rgb.cpu()))
        return costs.double().cpu().reshape(candidates, frames)

    def goal_features(self, image: UInt8[Tensor, "height width 3"]) -> Any:
        """Return the features of a goal image, those kept if it is the last one again."""
        if self._goal is None or not torch.equal(self._goal[0], image):
            self._goal = image, self.features(image[None])
        return self._goal[1]

    @abstractmethod
    def features(self, rgb: Frames) -> Any:
        """Return what ``compare`` needs of a single image."""

    @abstractmethod
    def compare(self, rgb: Frames, goal: Any) -> Float[Tensor, " frame"]:
        """Return the cost of each frame, given the goal's ``features``."""


class LpipsCost(ImageCost):
    """LPIPS-Alex between frame and goal image, the cost of the paper (Zhang et al. 2018, equation 1)."""

    @classmethod
    def missing(cls) -> str:
        """Say how LPIPS's weights are fetched, where they are missing."""
        return missing_weights(lpips.LpipsAlex.name) or ""

    def features(self, rgb: Frames) -> list[Tensor]:
        """Return the network's taps of the image."""
        least, size = lpips.LpipsAlex.least_size, min(rgb.shape[1:3])
        if size < least:
            raise PersistError(f"cost {self.name!r}: LPIPS takes images of at least {least} px, not {size}")
        with exact_inference():
            return lpips.features(self._weights, lpips.ALEX, rgb.to(network_device()))

    def compare(self, rgb: Frames, goal: list[Tensor]) -> Float[Tensor, " frame"]:
        """Return LPIPS of each frame."""
        weights = self._weights
        return run_network(
            lambda part: lpips.feature_distance(weights, lpips.features(weights, lpips.ALEX, part), goal), rgb
        )

    @property
    def _weights(self) -> dict[str, Tensor]:
        return network_weights(lpips.LpipsAlex.name, lpips.tensor_shapes(lpips.ALEX))


class DreamSimCost(ImageCost):
    """DreamSim, single branch, between frame and goal image (Fu et al. 2023)."""

    @classmethod
    def missing(cls) -> str:
        """Say how DreamSim's weights are prepared, where they are missing."""
        missing = missing_weights(dreamsim.WEIGHTS)
        return f"{missing} --from DIR" if missing else ""

    def features(self, rgb: Frames) -> Tensor:
        """Return the class token of the image."""
        with exact_inference():
            return dreamsim.class_token(self._weights, dreamsim.resize(rgb).to(network_device()))

    def compare(self, rgb: Frames, goal: Tensor) -> Float[Tensor, " frame"]:
        """Return DreamSim of each frame."""
        weights = self._weights
        resized = dreamsim.resize(rgb)
        return run_network(lambda part: dreamsim.token_distance(dreamsim.class_token(weights, part), goal), resized)

    @property
    def _weights(self) -> dict[str, Tensor]:
        return network_weights(dreamsim.WEIGHTS, dreamsim.tensor_shapes())


@dataclass(frozen=True)
class DinoSettings:
    """The size of the images that DINO sees.

    Args:
        size: pixels of the longer side, to which images are resized; a patch has 14 of them.
    """

    size: PositiveInt = 112


class DinoCost(ImageCost):
    """Mean squared difference of DINOv2's patch features of frame and goal image, as DINO-WM plans with."""

    settings_type = DinoSettings
    settings: DinoSettings

    @classmethod
    def missing(cls) -> str:
        """Say how weights of DINOv2 are fetched, where none are here."""
        return missing_weights(*(encoder.name for encoder in reversed(ENCODERS))) or ""

    def features(self, rgb: Frames) -> Tensor:
        """Return the patch features of the image."""
        missing = self.missing()
        if missing:
            raise PersistError(f"cost {self.name!r}: {missing}")
        return encode_frames(rgb, self.settings.size)

    def compare(self, rgb: Frames, goal: Tensor) -> Float[Tensor, " frame"]:
        """Return the mean over patches and channels of the squared difference."""
        return (self.features(rgb).double() - goal.double()).square().mean((1, 2, 3))
