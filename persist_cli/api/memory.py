"""The abstract memory of a scene, which is written from posed RGB-D frames and read for cameras to come."""

from __future__ import annotations

import dataclasses
import json
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.encoder import Encoder
from persist_cli.api.memory_file import FORMAT, FORMAT_VERSION
from persist_cli.api.observations import Observations, Origin, origins_like
from persist_cli.api.promises import check_figures, check_points, check_stored, check_tokens, kept
from persist_cli.api.scene_edits import Edit, EditOutcome
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import CheckpointError, PersistError, PluginError
from persist_cli.io.files import write_tensors
from persist_cli.io.settings import NoSettings

PATH = "path:"  # begins the names of tensors in a memory file that hold paths


@dataclass(frozen=True)
class FrameOfReference:
    """The world in which a memory's positions are given.

    Args:
        name: name of the scene; memories with one name share the world's origin.
        world_up: unit vector that points up in the world.
    """

    name: str
    world_up: tuple[float, float, float] = (0.0, -1.0, 0.0)


@dataclass(frozen=True)
class MemoryFigures:
    """The size of a memory.

    Args:
        cells: number of stored items (cells, snapshots, …).
        bytes: size of the stored tensors in bytes.
        bounds: lowest and highest corner in world metres, ``None`` without points.
        imagined: number of those items that were imagined; the others were observed.
    """

    cells: int
    bytes: int
    bounds: tuple[tuple[float, ...], tuple[float, ...]] | None
    imagined: int = 0

    @property
    def observed(self) -> int:
        """The number of items that were observed."""
        return self.cells - self.imagined


@dataclass(frozen=True)
class MapPoints:
    """Coloured points that draw a memory for people.

    Args:
        positions: world metres, float64.
        colors: uint8 RGB, 0…255.
        spread: side in metres of the square that is drawn for each point.
        origins: the ``Origin`` of each point, or its ``CellOrigin``; without it all are observed.
        rise: metres of height that each point stands for, half of them below it; infinite where heights are unknown.
        edges: for points that are middles of cells, the three edges of a cell as rows, world metres; that of its height
            is zero where heights are unknown.
    """

    positions: Float[Tensor, "point 3"]
    colors: UInt8[Tensor, "point 3"]
    spread: float = 0.05
    origins: UInt8[Tensor, " point"] = None  # type: ignore[assignment]  # set below
    rise: float = 0.0
    edges: Float[Tensor, "3 3"] | None = None

    def __post_init__(self) -> None:
        if self.origins is None:
            object.__setattr__(self, "origins", origins_like(self.positions, Origin.OBSERVED))


class Memory(ABC):
    """A memory of one scene.

    Args:
        settings: an instance of ``settings_type``, a dataclass of the recipe's settings.
        encoder: turns images into the features that are stored.
        reference: the world in which positions are given.
    """

    settings_type: ClassVar[type] = NoSettings
    usual_encoder: ClassVar[str] = "patches"  # the encoder when nobody names one
    reads_depth: ClassVar[bool] = True  # where it is false, ``memorize`` hides all depth from ``write``
    changeable: ClassVar[frozenset[str]] = frozenset()  # settings on which neither cells nor tokens depend in form
    name: str = ""  # set by the registry

    def __init__(self, settings: Any, encoder: Encoder, reference: FrameOfReference) -> None:
        self.settings = settings
        self.encoder = encoder
        self.reference = reference

    @abstractmethod
    def write(self, observations: Observations) -> None:
        """Add posed frames in metres of the reference's world; pixels without depth (0) get no position.

        ``observations.origins`` says which frames a model imagined. They shall not change what was observed, and an
        observation shall replace what was imagined of the same place. ``by_origin`` splits the frames. Others read
        the observations too, so a memory changes clones of them at most.

        Raises:
            DataError: when a pose is not finite and rigid, or sizes differ; then nothing is written.
        """

    def memorize(self, observations: Observations) -> None:
        """Write frames as this memory may see them: with depth 0 when it says that it reads none.

        All of persist writes memories by this method, so that "without depth" is no promise of a memory.

        Raises:
            DataError: as ``write`` does.
            PluginError: when it changes what it is given.
        """
        seen = observations if self.reads_depth else observations.without_depth()
        with kept("memory", self.name, "write", observations=seen):
            self.write(seen)

    def foresee(self, cameras: Sequence[Cameras]) -> None:  # noqa: B027  # most memories imagine nothing
        """Make ready to be read by camera paths; a scene imagines here what they will see and nobody has seen.

        A rollout calls it before each clip. Reading alone changes no memory. By default it does nothing.
        """

    @abstractmethod
    def read(self, cameras: Cameras, budget: int) -> MemoryTokens:
        """Return the tokens that matter most to a path of cameras, the most relevant first, as an unbatched sample.

        Args:
            cameras: posed cameras with the frame axis alone, in the reference's world.
            budget: largest number of tokens, at least 0.
        """

    def recall(self, cameras: Sequence[Cameras], budget: int, together: bool = False) -> list[MemoryTokens]:
        """Return the tokens of some camera paths, after a check that they are what ``read`` promises.

        All of persist reads memories by this method.

        Args:
            cameras: the paths.
            budget: largest number of tokens of each.
            together: whether the sample of ``read_together`` may stand for each path, where the memory has one.

        Raises:
            PluginError: when they are not, or the cameras are changed.
        """
        with kept("memory", self.name, "read", cameras=cameras):
            of_all = self.read_together(cameras, budget) if together else None
            read = self.read_batch(cameras, budget) if of_all is None else [of_all] * len(cameras)
        if not isinstance(read, Sequence) or len(read) != len(cameras):
            given = f"{len(read)} samples" if isinstance(read, Sequence) else f"a {type(read).__name__}"
            raise PluginError(f"memory {self.name!r}: read_batch gave {given} for {len(cameras)} paths")
        for tokens in read if of_all is None else read[:1]:
            check_tokens(tokens, self.name, self.encoder.channels, budget)
        return list(read)

    def read_batch(self, cameras: Sequence[Cameras], budget: int) -> list[MemoryTokens]:
        """Return for each camera path what ``read`` returns for it with the whole budget.

        A memory overrides this when it can search once for all paths; the results must be those of ``read``.
        """
        return [self.read(path, budget) for path in cameras]

    def read_together(self, cameras: Sequence[Cameras], budget: int) -> MemoryTokens | None:
        """Return one sample of all tokens that any of the paths sees, and perhaps of some beside, in any order.

        ``None``, as by default, where a path's tokens depend on the path, or all of them are more than the budget.
        """
        return None

    def copy(self) -> Self:
        """Return a memory with the same content; writing into one of the two does not change the other."""
        copy = type(self)(self.settings, self.encoder, self.reference)
        copy.restore({name: tensor.clone() for name, tensor in self.tensors().items()})
        return copy

    def check_copy(self) -> None:
        """Raise ``PluginError`` when a copy of this memory is none, or holds another number of items or bytes.

        A copy is made of ``tensors`` by ``restore``, as a memory that is read from its file.
        """
        check_stored(self.tensors(), self.name, PATH)
        copy = self.copy()
        if not isinstance(copy, Memory) or copy is self:
            given = "itself" if copy is self else type(copy).__name__
            raise PluginError(f"memory {self.name!r}: copy gave {given}, not another memory")
        for memory in (self, copy):
            check_points(memory.points(), self.name)
            check_figures(memory.figures(), self.name)
        own, copied = self.figures(), copy.figures()
        if (own.cells, own.imagined, own.bytes) != (copied.cells, copied.imagined, copied.bytes):
            text = "{0.cells} items ({0.imagined} imagined) of {0.bytes:,} bytes"
            what = f"restore made {text.format(copied)} of what tensors gave"
            raise PluginError(f"memory {self.name!r}: {what}, which was {text.format(own)}")

    @abstractmethod
    def tensors(self) -> dict[str, Tensor]:
        """Return the stored tensors by name, in an order that does not depend on the order of writing."""

    @abstractmethod
    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Replace the content by tensors that ``tensors()`` returned; an empty dictionary empties the memory.

        Raises:
            CheckpointError: when they are not tensors of this memory; then the content stays as it was.
        """

    def to(self, device: torch.device | str) -> Self:
        """Move this memory and its encoder to ``device`` and return it; an empty one follows the frames written."""
        self.encoder = self.encoder.placed(device)
        self.restore({name: tensor.to(device) for name, tensor in self.tensors().items()})
        return self

    def placed(self, device: torch.device | str) -> Self:
        """Return what ``to`` does, after a check that it is this memory. Persist moves memories by this method.

        Raises:
            PluginError: when it is not.
        """
        moved = self.to(device)
        if moved is not self:
            raise PluginError(f"memory {self.name!r}: to gave {type(moved).__name__}; it must return the memory itself")
        return moved

    def merge(self, other: Memory) -> None:
        """Add the content of another memory, of one kind and reference; ``CheckpointError`` when they do not match."""
        raise CheckpointError(f"a memory of kind {self.name!r} cannot be merged")

    def edit(self, edits: Sequence[Edit], seed: int = 0) -> EditOutcome:
        """Change what is stored by hand, all edits or none; by default a memory cannot be edited.

        Args:
            edits: the edits, which are done one after the other.
            seed: of what is imagined where a thing was that is taken away.

        Raises:
            PersistError: when a memory of this kind cannot be edited.
            DataError: when an edit cannot be done; then nothing changes.
        """
        raise PersistError(f"a memory of kind {self.name!r} cannot be edited; a scene or a map of cells can")

    def clear(self) -> None:
        """Empty the memory."""
        self.restore({})

    def points(self) -> MapPoints:
        """Return coloured points for drawing the memory; by default there are none."""
        return MapPoints(torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, 3, dtype=torch.uint8))

    def figures(self) -> MemoryFigures:
        """Return the number of stored items, their bytes and their bounds."""
        tensors = self.tensors()
        positions = self.points().positions
        bounds = (tuple(positions.amin(0).tolist()), tuple(positions.amax(0).tolist())) if len(positions) else None
        size = sum(tensor.numel() * tensor.element_size() for tensor in tensors.values())
        return MemoryFigures(max((len(tensor) for tensor in tensors.values()), default=0), size, bounds)

    def resolution(self, cameras: Cameras, distance: float = 2.5) -> float | None:
        """Return the edge in metres of the smallest thing that it can tell apart; ``None`` when it does not know.

        Args:
            cameras: cameras such as those of the frames that are written.
            distance: metres between camera and thing.
        """
        return None

    def header(self) -> dict[str, Any]:
        """Return the JSON values that a memory file holds beside its tensors: kind, settings, encoder, reference.

        Raises:
            PluginError: when the memory's figures are no numbers of items.
        """
        figures = self.figures()
        check_figures(figures, self.name)
        return {
            "format": FORMAT,
            "version": FORMAT_VERSION,
            "memory": self.name,
            "settings": dataclasses.asdict(self.settings),
            "encoder": self.encoder.name,
            "encoder_settings": dataclasses.asdict(self.encoder.settings),
            "channels": self.encoder.channels,
            "reference": self.reference.name,
            "world_up": list(self.reference.world_up),
            "cells": figures.cells,
            "imagined": figures.imagined,
        }

    def save(self, path: Path, paths: Mapping[str, Float[Tensor, "frame 4 4"]] | None = None) -> None:
        """Write a memory file, whole or not at all: safetensors with ``header()``.

        Args:
            path: the file.
            paths: world_from_camera of the paths along which the frames were seen, by name, for drawing.

        Raises:
            OSError: when it cannot be written.
            PluginError: when what the memory gives can be no memory file.
        """
        tensors = self.tensors()
        check_stored(tensors, self.name, PATH)
        check_points(self.points(), self.name)
        poses = {PATH + name: poses.contiguous() for name, poses in (paths or {}).items()}
        write_tensors(path, dict(tensors) | poses, {"persist": json.dumps(self.header())})
