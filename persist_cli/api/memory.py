"""The abstract memory of a scene: written from posed RGB-D, read by the cameras that will look."""

from __future__ import annotations

import dataclasses
import json
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.encoder import Encoder
from persist_cli.api.observations import Observations
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import CheckpointError
from persist_cli.io.files import write_tensors
from persist_cli.io.settings import NoSettings

FORMAT_VERSION = 1


@dataclass(frozen=True)
class FrameOfReference:
    """Which world a memory's metres belong to.

    Args:
        name: the scene; memories of one name share their origin.
        world_up: unit vector.
    """

    name: str
    world_up: tuple[float, float, float] = (0.0, -1.0, 0.0)


@dataclass(frozen=True)
class MemoryFigures:
    """Figures of a memory about itself.

    Args:
        cells: stored places (cells, snapshots, …).
        bytes: size of what is stored.
        bounds: lowest and highest corner in world metres, ``None`` when empty.
    """

    cells: int
    bytes: int
    bounds: tuple[tuple[float, ...], tuple[float, ...]] | None


@dataclass(frozen=True)
class MapPoints:
    """What a memory looks like: coloured points for drawing, never for the model.

    Args:
        positions: world metres, float64.
        colors: uint8 RGB.
        spread: metres across of what each point stands for.
    """

    positions: Float[Tensor, "point 3"]
    colors: UInt8[Tensor, "point 3"]
    spread: float = 0.05


class Memory(ABC):
    """A memory of one scene.

    Args:
        settings: an instance of ``settings_type``.
        encoder: what turns images into features.
        reference: the world that positions belong to.
    """

    settings_type: ClassVar[type] = NoSettings
    name: str = ""  # set by the registry

    def __init__(self, settings: Any, encoder: Encoder, reference: FrameOfReference) -> None:
        self.settings = settings
        self.encoder = encoder
        self.reference = reference

    @abstractmethod
    def write(self, observations: Observations) -> None:
        """Take in posed frames; those without valid depth leave out what cannot be placed."""

    @abstractmethod
    def read(self, cameras: Cameras, budget: int) -> MemoryTokens:
        """At most ``budget`` tokens of what the cameras will look at, the most relevant first."""

    def read_batch(self, cameras: Sequence[Cameras], budget: int) -> list[MemoryTokens]:
        """What ``read`` gives each of several askers, each with the whole budget of its own.

        A memory that can look once for all of them overrides this; every asker gets what it would get alone.
        """
        return [self.read(each, budget) for each in cameras]

    def copy(self) -> Self:
        """Another memory that holds the same; what is written into one of both does not change the other."""
        twin = type(self)(self.settings, self.encoder, self.reference)
        twin.restore({name: tensor.clone() for name, tensor in self.tensors().items()})
        return twin

    @abstractmethod
    def tensors(self) -> dict[str, Tensor]:
        """Everything stored, in an order that does not depend on how it was written."""

    @abstractmethod
    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Replace what is stored by what ``tensors()`` gave; an empty dictionary empties the memory."""

    def to(self, device: torch.device | str) -> Self:
        """This memory, encoding and holding what it holds on ``device``; an empty one goes where it is written from."""
        self.encoder = self.encoder.to(device)
        self.restore({name: tensor.to(device) for name, tensor in self.tensors().items()})
        return self

    def merge(self, other: Memory) -> None:
        """Take in another memory of the same kind and frame of reference."""
        raise CheckpointError(f"a memory of kind {self.name!r} cannot be merged")

    def clear(self) -> None:
        """Forget everything."""
        self.restore({})

    def points(self) -> MapPoints:
        """Coloured points for drawing the memory; none unless the memory has some."""
        return MapPoints(torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, 3, dtype=torch.uint8))

    def figures(self) -> MemoryFigures:
        """Cells, bytes and bounds."""
        tensors = self.tensors()
        positions = self.points().positions
        low_high = (tuple(positions.amin(0).tolist()), tuple(positions.amax(0).tolist())) if len(positions) else None
        size = sum(tensor.numel() * tensor.element_size() for tensor in tensors.values())
        return MemoryFigures(max((len(tensor) for tensor in tensors.values()), default=0), size, low_high)

    def header(self) -> dict[str, Any]:
        """What a memory file says about itself, JSON values."""
        return {
            "format": "persist-memory",
            "version": FORMAT_VERSION,
            "memory": self.name,
            "settings": dataclasses.asdict(self.settings),
            "encoder": self.encoder.name,
            "encoder_settings": dataclasses.asdict(self.encoder.settings),
            "channels": self.encoder.channels,
            "reference": self.reference.name,
            "world_up": list(self.reference.world_up),
            "cells": self.figures().cells,
        }

    def save(self, path: Path) -> None:
        """Write a memory file: safetensors with a versioned header, written aside and renamed."""
        write_tensors(path, self.tensors(), {"persist": json.dumps(self.header())})
