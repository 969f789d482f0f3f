"""Edits of a map of pooled features by hand: its cells are removed, painted, moved and copied.

Such a map knows no classes and no free space. Where a cell is removed nothing is known any more, so that a model
imagines something there or a new observation fills it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Int64
from torch import Tensor

from persist_cli.api.cells import CellOrigin
from persist_cli.api.encoder import Encoder
from persist_cli.api.scene_edits import Copy, Edit, EditOutcome, Insert, Move, Paint, Point, Remove, last_moved
from persist_cli.errors import DataError
from persist_memory.grid.pooling import Lattice
from persist_memory.grid.storage import LIMIT, pack
from persist_memory.validation import ORIGINS

Boxed = Remove | Paint | Move | Copy

PICTURE = 64  # pixels of the side of a picture of one colour, whose features painted cells get

BORDER = 1e-6  # metres by which a box is grown, so that rounding leaves no cell of it out
CELLS = "cells"  # the tensor with the coordinates of each cell


@dataclass(frozen=True)
class MapForm:
    """Where the cells of a map lie in the world, and what makes their features.

    Args:
        lattice: size and axes of the cells.
        world_up: unit vector that points up in the world.
        encoder: the map's encoder.
    """

    lattice: Lattice
    world_up: tuple[float, float, float]
    encoder: Encoder

    @property
    def height_axis(self) -> int:
        """The axis of the lattice that is (nearly) vertical."""
        return int((self.lattice.grid_from_world @ torch.tensor(self.world_up, dtype=torch.float64)).abs().argmax())

    def nearest_shift(self, by: Point) -> Int64[Tensor, " 3"]:
        """Return by how many cells along each axis cells move that are told to by a vector, world metres."""
        steps = (self.lattice.grid_from_world @ torch.tensor(by, dtype=torch.float64)) / self.lattice.size
        shift: Int64[Tensor, " 3"] = steps.round().clamp(-2 * LIMIT, 2 * LIMIT).long()
        if self.lattice.flat:
            shift[self.height_axis] = 0
        return shift


def edit_cells(
    tensors: Mapping[str, Tensor], form: MapForm, edits: Sequence[Edit]
) -> tuple[dict[str, Tensor], EditOutcome]:
    """Return the tensors of a map after some edits, and how many cells they changed.

    Args:
        tensors: as ``GridMemory.tensors`` gives them; they stay as they are.
        form: where the cells lie, and what makes their features.
        edits: done one after the other.

    Raises:
        DataError: when a box holds no cell, something is put where something is, or an edit needs classes.
    """
    edited, changed = dict(tensors), 0
    for number, edit in enumerate(edits, 1):
        try:
            edited, count = _apply(edited, form, edit)
        except DataError as error:
            raise DataError(f"edit {number} ({edit.edit}): {error}") from error
        changed += count
    lattice = form.lattice
    moved = last_moved(edits, lambda by: form.nearest_shift(by) * lattice.size @ lattice.grid_from_world)
    return edited, EditOutcome(changed, moved=moved)


def _apply(tensors: dict[str, Tensor], form: MapForm, edit: Edit) -> tuple[dict[str, Tensor], int]:
    """Return the tensors after an edit, and how many cells it removed, changed or added."""
    if isinstance(edit, Insert):
        raise DataError(
            "a map stores features of images, and a thing that was never seen has none; scenes take what is inserted"
        )
    inside = _in_box(tensors, form, edit)
    count = int(inside.sum())
    if isinstance(edit, Paint):
        return _painted(tensors, inside, form, edit), count
    left = tensors if isinstance(edit, Copy) else {name: tensor[~inside] for name, tensor in tensors.items()}
    if isinstance(edit, Remove):
        return left, count
    taken = {name: tensor[inside] for name, tensor in tensors.items()}
    joined = _joined(left, _shifted(taken, form, edit), edit.overwrite)
    return joined, count * (2 if isinstance(edit, Move) else 1)


def _in_box(tensors: Mapping[str, Tensor], form: MapForm, edit: Boxed) -> Bool[Tensor, " cell"]:
    """Return which cells have their middle in a box seen from above, and are touched by it in height."""
    if not tensors or not len(tensors[CELLS]):
        raise DataError("the memory is empty")
    lattice, height = form.lattice, form.height_axis
    cells = tensors[CELLS].cpu().double()
    corners = torch.tensor([edit.low, edit.high], dtype=torch.float64)
    around = torch.cartesian_prod(*corners.T.unbind(0)) @ lattice.grid_from_world.T
    reach = torch.zeros(3, dtype=torch.float64)
    reach[height] = 0.5
    within = ((cells + reach) * lattice.size > around.amin(0) - BORDER) & (
        (cells - reach) * lattice.size < around.amax(0) + BORDER
    )
    within[:, height] |= lattice.flat
    inside: Bool[Tensor, " cell"] = within.all(dim=-1)
    if not bool(inside.any()):
        ends = (cells * lattice.extent) @ lattice.grid_from_world
        low, high = (",".join(f"{value:g}" for value in end.tolist()) for end in (ends.amin(0), ends.amax(0)))
        raise DataError(f"the box holds the middle of no cell; these lie from {low} to {high}")
    return inside.to(tensors[CELLS].device)


def _painted(
    tensors: Mapping[str, Tensor], inside: Bool[Tensor, " cell"], form: MapForm, edit: Paint
) -> dict[str, Tensor]:
    """Return the tensors with cells that are as if a picture of the colour alone had been seen there."""
    picture = torch.tensor(edit.color, dtype=torch.uint8).expand(1, PICTURE, PICTURE, 3)
    encoded = form.encoder.encoded(picture.to(tensors[CELLS].device))[0]
    painted = {name: tensor.clone() for name, tensor in tensors.items()}
    red, green, blue = edit.color
    painted["colors"][inside] = (red << 16) | (green << 8) | blue  # at depth 0: no later pixel is nearer
    painted["features"][inside] = encoded[encoded.shape[0] // 2, encoded.shape[1] // 2].to(painted["features"])
    painted[ORIGINS][inside] = CellOrigin.EDITED
    if "counts" in painted:
        painted["counts"][inside] = 1
    return painted


def _shifted(taken: Mapping[str, Tensor], form: MapForm, edit: Move | Copy) -> dict[str, Tensor]:
    """Return cells at their new places."""
    shift = form.nearest_shift(edit.by)
    if not bool(shift.any()):
        sizes = " × ".join(f"{side:g}" for side in form.lattice.size.tolist())
        raise DataError(f"by {','.join(f'{value:g}' for value in edit.by)} is less than half a cell of {sizes} m")
    cells = taken[CELLS].long() + shift.to(taken[CELLS].device)
    if not bool(((cells >= -LIMIT) & (cells < LIMIT)).all()):
        raise DataError("it would reach out of all that a map can hold")
    origins = torch.full_like(taken[ORIGINS], CellOrigin.EDITED)
    return {**taken, CELLS: cells.to(taken[CELLS].dtype), ORIGINS: origins}


def _joined(left: Mapping[str, Tensor], moved: Mapping[str, Tensor], overwrite: bool) -> dict[str, Tensor]:
    """Return cells with others among them, in the order of their keys."""
    keys, new = (pack(*part[CELLS].long().unbind(-1)) for part in (left, moved))
    taken = torch.isin(keys, new)
    if bool(taken.any()) and not overwrite:
        raise DataError(
            f"it would stand in {int(taken.sum())} cells that hold something; take another place, or let it replace "
            "them (--overwrite)"
        )
    order = torch.cat([keys[~taken], new]).argsort()
    return {name: torch.cat([left[name][~taken], moved[name]])[order] for name in left}
