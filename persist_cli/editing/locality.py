"""Where an edit of a scene can be seen, and how much pictures change there and elsewhere."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import torch
from jaxtyping import Bool, UInt8
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.cell_rays import first_surfaces, sheet_cells
from persist_cli.api.cell_things import floor_level
from persist_cli.api.cells import CellGrid

MARK: Final = 255  # stands for changed cells, which no palette numbers so high


@dataclass(frozen=True)
class EditLocality:
    """How much some pictures differ from those of the same cameras before an edit.

    Args:
        inside: mean absolute difference of the pixels that look at edited cells, 0…255; NaN without such a pixel.
        outside: that of all other pixels; NaN without such a pixel.
        share: share of the pixels that look at edited cells.
    """

    inside: float
    outside: float
    share: float


def edited_pixels(
    before: CellGrid, after: CellGrid, cameras: Cameras, around: int = 0
) -> Bool[Tensor, "frame height width"]:
    """Return which pixels look at cells that differ: at their content, or through them at what was behind.

    Args:
        before: the cells before the edit.
        after: the cells after it; of the same box of the lattice.
        cameras: the cameras, with the frame axis alone.
        around: pixels at the border that count too, since a renderer's pixels are not the cells' to the pixel.
    """
    changed = changed_cells(before, after)
    seen = torch.zeros(len(cameras), cameras.height, cameras.width, dtype=torch.bool)
    for grid in (before, after):
        marked = replace(grid, classes=torch.where(changed, MARK, grid.classes))
        sheets = flat_cells(grid) & ~changed
        first = first_surfaces(marked, cameras, opaque=grid.solid | changed, sheets=sheets)
        seen |= first.classes(marked)[0] == MARK
    if around:
        wide = torch.nn.functional.max_pool2d(seen.float()[:, None], 2 * around + 1, 1, around)
        seen = wide[:, 0] > 0
    return seen


def flat_cells(grid: CellGrid) -> Bool[Tensor, "first second level"]:
    """Return which cells are drawn as a thin floor or ceiling."""
    floor = floor_level(grid)
    return sheet_cells(grid, grid.corner[2] + (0 if floor is None else floor))


def changed_cells(before: CellGrid, after: CellGrid) -> Bool[Tensor, "first second level"]:
    """Return which cells of two grids of one box look different: what is solid, its class, colour or shape."""
    content = (before.classes != after.classes) | (before.colors != after.colors).any(dim=-1)
    content |= flat_cells(before) != flat_cells(after)
    return (before.solid != after.solid) | (before.solid & after.solid & content)


def edit_locality(
    before: UInt8[Tensor, "frame height width 3"],
    after: UInt8[Tensor, "frame height width 3"],
    edited: Bool[Tensor, "frame height width"],
) -> EditLocality:
    """Return how much pictures change where an edit is seen, and elsewhere.

    Args:
        before: pictures before the edit.
        after: pictures of the same cameras after it, sampled with the same noise.
        edited: pixels that look at edited cells, as ``edited_pixels`` gives them.
    """
    difference = (after.float() - before.float()).abs().mean(dim=-1)
    inside, outside = difference[edited].mean(), difference[~edited].mean()
    return EditLocality(float(inside), float(outside), float(edited.float().mean()))
