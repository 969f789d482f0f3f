"""What becomes of cells when an agent picks up, drops or toggles a thing, by the rules of the simulator."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor

from persist_cli.api.cell_things import Thing, find_things, floor_level
from persist_cli.api.cells import FREE, CellGrid, CellOrigin
from persist_cli.api.ground import Body
from persist_cli.api.reach import AHEAD, CHANGED, REACH, place_and_heading
from persist_cli.errors import CheckpointError
from persist_memory.scene.support import standing_on
from persist_memory.scene.surroundings import fill_from_surroundings
from persist_memory.validation import Shape, check_classes, part_of

BEFORE = 0.3  # metres between the agent's body and the thing that it puts down


LOAD: dict[str, tuple[torch.dtype, Shape]] = {
    "carried.cells": (torch.int32, (None, 3)),
    "carried.classes": (torch.uint8, (None,)),
    "carried.colors": (torch.uint8, (None, 3)),
}


@dataclass(frozen=True)
class Load:
    """A thing that is carried, as cells.

    Args:
        cells: where they are, from the middle of its lowest level.
        classes: what each cell holds.
        colors: their RGB.
    """

    cells: Int64[Tensor, "cell 3"]
    classes: UInt8[Tensor, " cell"]
    colors: UInt8[Tensor, "cell 3"]

    @property
    def kind(self) -> int:
        """The class of the thing."""
        return int(self.classes[0])

    @property
    def color(self) -> UInt8[Tensor, " 3"]:
        """Its mean colour."""
        return self.colors.double().mean(0).round().to(torch.uint8)

    @staticmethod
    def taken(grid: CellGrid, cells: Int64[Tensor, "cell 3"]) -> Load:
        """Return the load that some cells of a grid are, given as places in it."""
        low, high = cells.amin(0), cells.amax(0)
        middle = torch.stack([(low[0] + high[0]) // 2, (low[1] + high[1]) // 2, low[2]])
        at = tuple(cells.unbind(1))
        return Load(cells - middle, grid.classes[at].clone(), grid.colors[at].clone())

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors that ``read_load`` takes back."""
        return dict(zip(LOAD, (self.cells.to(torch.int32), self.classes, self.colors), strict=True))


def read_load(tensors: Mapping[str, Tensor], classes: int, where: str) -> Load | None:
    """Return the carried thing among the tensors of a memory of so many classes, on the CPU, ``None`` without one.

    Raises:
        CheckpointError: when a part of it is missing or damaged, or it is of another class.
    """
    parts = part_of(tensors, LOAD, where)
    if parts and (len({len(part) for part in parts}) > 1 or not len(parts[0])):
        raise CheckpointError(f"{where}: the carried thing has {[len(part) for part in parts]} cells, classes, colours")
    if parts:
        check_classes(parts[1], classes, where, "the carried thing")
    return Load(parts[0].long().cpu(), parts[1].cpu(), parts[2].cpu()) if parts else None


@dataclass(frozen=True)
class Reached:
    """The surroundings of an agent that acts.

    Args:
        grid: cells around it; they are changed in place.
        world_from_camera: pose of its camera.
        body: its body.
        largest: metres along each axis of the largest thing that can be carried.
    """

    grid: CellGrid
    world_from_camera: Float[Tensor, "4 4"]
    body: Body
    largest: float

    def thing(self) -> Thing | None:
        """Return the nearest thing ahead that is small enough to be carried, with nothing before or on it."""
        place, ahead = place_and_heading(self.world_from_camera, self.grid.axes)
        size, near = self.grid.form.size, []
        for thing in find_things(self.grid):
            span = (thing.cells.amax(0) - thing.cells.amin(0) + 1) * size
            if float(span.max()) > self.largest + 1e-6:
                continue
            offset = self._middle(thing.cells) - place
            distance, radius = float(offset.norm()), float(span[:2].max()) / 2
            in_reach = distance < REACH + radius and float(offset @ ahead) > AHEAD * distance
            if in_reach and self._in_sight(thing, offset) and not self._holds_another(thing):
                near.append((distance, thing.name, thing))
        return min(near, key=lambda one: one[:2])[2] if near else None

    def pick_up(self) -> Load | None:
        """Take the thing ahead away, and return it; ``None`` when there is none."""
        thing = self.thing()
        if thing is None:
            return None
        at = tuple(thing.cells.unbind(1))
        load = Load.taken(self.grid, thing.cells)
        self.grid.classes[at], self.grid.colors[at], self.grid.origins[at] = FREE, 0, CellOrigin.IMAGINED
        self._uncover(thing.cells)
        return load

    def drop(self, load: Load) -> bool:
        """Put a carried thing on the floor ahead; false, and nothing changes, where it has no room."""
        place, ahead = place_and_heading(self.world_from_camera, self.grid.axes)
        size, floor = self.grid.form.size, floor_level(self.grid)
        eye = float(self.grid.axes[2] @ self.world_from_camera[:3, 3].double())
        lowest = round((eye - self.body.camera_height) / size) - self.grid.corner[2] if floor is None else floor
        across = (load.cells[:, :2].amax(0) - load.cells[:, :2].amin(0) + 1).max()
        at = place + ahead * (self.body.radius + BEFORE + float(across) * size / 2)
        middle = (at / size).round().long() - torch.tensor(self.grid.corner[:2])
        cells = load.cells + torch.tensor([int(middle[0]), int(middle[1]), lowest + 1])
        if bool(((cells < 0) | (cells >= torch.tensor(self.grid.shape))).any()):
            return False
        where = tuple(cells.unbind(1))
        if bool(self.grid.solid[where].any()) or not self._free_way(self.grid.solid, at - place, cells[:, 2].unique()):
            return False
        self.grid.classes[where], self.grid.colors[where] = load.classes, load.colors
        self.grid.origins[where] = CellOrigin.IMAGINED
        return True

    def toggle(self, kinds: tuple[str, ...]) -> bool:
        """Turn the colour of the thing ahead into its complement, if it is of one of these classes."""
        thing = self.thing()
        if thing is None or thing.kind not in kinds:
            return False
        at = tuple(thing.cells.unbind(1))
        self.grid.colors[at] = 255 - self.grid.colors[at]
        self.grid.origins[at] = CellOrigin.IMAGINED
        return True

    def _middle(self, cells: Int64[Tensor, "cell 3"]) -> Float[Tensor, " 2"]:
        """The middle of the box around some cells, on the ground axes, metres."""
        middle = (cells[:, :2].amin(0) + cells[:, :2].amax(0)).double() / 2
        return (middle + torch.tensor(self.grid.corner[:2])) * self.grid.form.size

    def _in_sight(self, thing: Thing, offset: Float[Tensor, " 2"]) -> bool:
        """Whether no other solid cell at the thing's own height lies on the straight way to its middle."""
        solid = self.grid.solid.clone()
        solid[tuple(thing.cells.unbind(1))] = False
        return self._free_way(solid, offset, thing.cells[:, 2].amax()[None])

    def _free_way(
        self, solid: Bool[Tensor, "first second level"], offset: Float[Tensor, " 2"], levels: Int64[Tensor, " level"]
    ) -> bool:
        """Whether the straight way from the agent to an offset on the ground is free at some levels."""
        place, _ = place_and_heading(self.world_from_camera, self.grid.axes)
        size = self.grid.form.size
        shares = torch.linspace(0, 1, math.ceil(2 * float(offset.norm()) / size) + 2, dtype=torch.float64)
        cells = ((place + shares[:, None] * offset) / size).round().long() - torch.tensor(self.grid.corner[:2])
        return not bool(solid[cells[:, 0], cells[:, 1]][:, levels].any())

    def _holds_another(self, thing: Thing) -> bool:
        """Whether something stands on a thing and on nothing else."""
        own = torch.zeros_like(self.grid.solid)
        own[tuple(thing.cells.unbind(1))] = True
        return bool(standing_on(self.grid, own))

    def _uncover(self, cells: Int64[Tensor, "cell 3"]) -> None:
        """Let the floor go on where a thing stood on cells that nobody saw."""
        hidden = torch.zeros_like(self.grid.known)
        hidden[cells[:, 0], cells[:, 1], : int(cells[:, 2].amin())] = True
        hidden &= ~self.grid.known
        if bool(hidden.any()):
            filled = fill_from_surroundings(self.grid, hidden)
            for mine, theirs in zip(self.grid.tensors(), filled.tensors(), strict=True):
                mine.copy_(theirs)


def reached_box(grid: CellGrid, world_from_camera: Float[Tensor, "4 4"]) -> CellGrid:
    """Return a copy of the cells around an agent, as far as it can act and at all heights."""
    place, _ = place_and_heading(world_from_camera, grid.axes)
    around = math.ceil((CHANGED + 1) / grid.form.size)
    middle = (place / grid.form.size).round().long()
    first, second = int(middle[0]) - around, int(middle[1]) - around
    return grid.box((first, second, grid.corner[2]), (2 * around + 1, 2 * around + 1, grid.shape[2]))


def changed_cells(before: CellGrid, after: CellGrid) -> Bool[Tensor, "first second level"]:
    """Return which cells of two grids of one box differ."""
    pairs = zip(before.tensors(), after.tensors(), strict=True)
    classes, colors, origins = (mine != theirs for mine, theirs in pairs)
    return classes | colors.any(-1) | origins
