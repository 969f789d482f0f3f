"""The abstract network of a learned policy, and the samples of trajectories that it is trained on."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor, nn

from persist_cli.api.stages import ParameterGroup
from persist_cli.io.settings import NoSettings


@dataclass(frozen=True)
class SampleForm:
    """The form of the samples that a network is trained on.

    Args:
        context: frames before the present one.
        waypoints: places to come.
        spacing: frames of the trajectory from one of these to the next, and in a unit of distance to the goal.
        farthest: spacings to the farthest goal, which goals of other trajectories are said to have too.
        nearest: spacings to the goal above which the waypoints lead to it.
        negatives: share of the samples whose goal is a frame of another trajectory.
    """

    context: int = 3
    waypoints: int = 8
    spacing: int = 1
    farthest: int = 20
    nearest: int = 3
    negatives: float = 0.05


@dataclass(frozen=True)
class PolicySample:
    """One moment of a trajectory with what came before and after; see ``PolicySamples``.

    Args:
        seen: frames up to the present one.
        goal: what is seen at the goal.
        waypoints: places to come.
        distance: spacings of frames to the goal.
        goal_place: metres ahead and to the left to the goal, and the heading there; zeros where they are unknown.
        leads_to_goal: whether the waypoints lead to the goal.
        seed: seed of all random numbers of the sample.
    """

    seen: UInt8[Tensor, "frame height width 3"]
    goal: UInt8[Tensor, "height width 3"]
    waypoints: Float[Tensor, "waypoint 2"]
    distance: float
    goal_place: Float[Tensor, " 4"]
    leads_to_goal: bool
    seed: int


@dataclass(frozen=True)
class PolicySamples:
    """A batch of moments of trajectories.

    Args:
        seen: frames up to the present one, which is the last, uint8, 0…255.
        goal: what is seen at the goal, uint8, 0…255.
        waypoints: metres ahead and to the left of the present camera, float32; of a trajectory that ends before, its
            end.
        distance: spacings of frames to the goal, float32.
        goal_place: metres from the present camera to the goal, ahead and to the left, and the heading there as a unit
            vector in these axes, float32; zeros for a goal of another trajectory.
        leads_to_goal: whether the waypoints lead to the goal: it is of the same trajectory, and neither near nor far.
        seeds: for each sample the seed of all its random numbers.
    """

    seen: UInt8[Tensor, "batch frame height width 3"]
    goal: UInt8[Tensor, "batch height width 3"]
    waypoints: Float[Tensor, "batch waypoint 2"]
    distance: Float[Tensor, " batch"]
    goal_place: Float[Tensor, "batch 4"]
    leads_to_goal: Bool[Tensor, " batch"]
    seeds: Sequence[int]

    @staticmethod
    def stack(samples: Sequence[PolicySample]) -> PolicySamples:
        """Return a batch of samples of one image size."""
        return PolicySamples(
            seen=torch.stack([sample.seen for sample in samples]),
            goal=torch.stack([sample.goal for sample in samples]),
            waypoints=torch.stack([sample.waypoints for sample in samples]),
            distance=torch.tensor([sample.distance for sample in samples], dtype=torch.float32),
            goal_place=torch.stack([sample.goal_place for sample in samples]),
            leads_to_goal=torch.tensor([sample.leads_to_goal for sample in samples]),
            seeds=[sample.seed for sample in samples],
        )

    def to(self, device: torch.device | str) -> PolicySamples:
        """Return these samples on ``device``."""
        return replace(
            self,
            seen=self.seen.to(device),
            goal=self.goal.to(device),
            waypoints=self.waypoints.to(device),
            distance=self.distance.to(device),
            goal_place=self.goal_place.to(device),
            leads_to_goal=self.leads_to_goal.to(device),
        )


class PolicyNetwork(nn.Module, ABC):
    """The network of a learned policy; ``forward`` is its training loss.

    Args:
        settings: an instance of ``settings_type``, a dataclass of the recipe's ``policy.settings``.
    """

    settings_type: ClassVar[type] = NoSettings

    def __init__(self, settings: Any) -> None:
        super().__init__()
        self.settings = settings

    @property
    @abstractmethod
    def sample_form(self) -> SampleForm:
        """The form of the samples that ``forward`` takes."""

    @abstractmethod
    def forward(self, samples: PolicySamples, stage: str) -> dict[str, Tensor]:
        """Return scalar tensors of one training step by name; ``"loss"`` is minimised, the others are logged."""

    def trained_parameters(self) -> dict[str, nn.Parameter]:
        """Return the parameters that are trained, by name; all by default."""
        return dict(self.named_parameters())

    def parameter_groups(self) -> list[ParameterGroup]:
        """Return every parameter in exactly one group, in the order of a table for people."""
        return [ParameterGroup("policy", dict(self.named_parameters()))]

    @abstractmethod
    def save(self, folder: Path) -> None:
        """Write the weights into an existing folder, as safetensors and JSON files only."""

    @abstractmethod
    def load(self, folder: Path) -> None:
        """Load the weights that ``save`` wrote; the network may be on the meta device.

        Raises:
            CheckpointError: when a file is missing or corrupt, or a tensor has another shape.
        """
