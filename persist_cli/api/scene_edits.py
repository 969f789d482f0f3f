"""Edits of a scene by hand: boxes that are removed, painted, moved or copied, and things that are put in."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

if TYPE_CHECKING:
    from torch import Tensor

Metres = Annotated[float, Field(allow_inf_nan=False)]
Point = tuple[Metres, Metres, Metres]
Length = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Shade = Annotated[int, Field(ge=0, le=255)]
Colour = tuple[Shade, Shade, Shade]


class _Edit(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Remove(_Edit):
    """Take away what is in a box; what stood behind it is then seen, and imagined where it was never seen."""

    edit: Literal["remove"] = "remove"
    low: Point
    high: Point


class Paint(_Edit):
    """Give all that is in a box one colour."""

    edit: Literal["paint"] = "paint"
    low: Point
    high: Point
    color: Colour


class Insert(_Edit):
    """Put a thing of a class at a place: a box of cells whose lowest face has its middle there.

    Where a coordinate is ``None``, which only the height may be, it stands on what is there already. Its size is given
    along the world's axes; in a world that is not upright each axis of the cells takes that of the nearest one. Without
    a size or colour it gets that of the scene's own things of this class, or a usual one.
    """

    edit: Literal["insert"] = "insert"
    kind: str
    at: tuple[Metres | None, Metres | None, Metres | None]
    size: tuple[Length, Length, Length] | None = None
    color: Colour | None = None
    overwrite: bool = False  # take the place of what is there, where it would else be an error


class Move(_Edit):
    """Move what is in a box by a vector in metres; where it was is treated as by ``Remove``."""

    edit: Literal["move"] = "move"
    low: Point
    high: Point
    by: Point
    overwrite: bool = False


class Copy(_Edit):
    """Put what is in a box at a second place too, a vector in metres away."""

    edit: Literal["copy"] = "copy"
    low: Point
    high: Point
    by: Point
    overwrite: bool = False


FilledBy = Literal["model", "surroundings", "both"]

Edit = Annotated[Remove | Paint | Insert | Move | Copy, Field(discriminator="edit")]


@dataclass(frozen=True)
class EditOutcome:
    """What became of some edits.

    Args:
        changed: cells that hold another thing or have another colour now, the uncovered ones too.
        uncovered: cells that were never seen, behind or below what was taken away, and hold something or nothing now.
        filled_by: what says what the uncovered cells hold: a model that imagines, their surroundings, or for some cells
            the one and for some the other; ``None`` where no cell was uncovered.
        moved: how far the last edit that moves or copies took its cells, world metres, since cells move by whole ones.
            ``None`` where there is no such edit, or the memory does not say.
    """

    changed: int
    uncovered: int = 0
    filled_by: FilledBy | None = None
    moved: Point | None = None


def last_moved(edits: Sequence[Edit], in_whole_cells: Callable[[Point], Tensor]) -> Point | None:
    """Return ``EditOutcome.moved`` of some edits.

    Args:
        edits: done one after the other.
        in_whole_cells: returns how far cells move that are told to by a vector; both world metres.
    """
    by = next((edit.by for edit in reversed(edits) if isinstance(edit, Move | Copy)), None)
    if by is None:
        return None
    x, y, z = in_whole_cells(by).tolist()
    return x, y, z
