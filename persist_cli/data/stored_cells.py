"""The cells of a scene in a trajectory's file: all of them at the first frame, and what changes at later ones."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from persist_cli.api.cells import COMMON, CellForm, CellGrid
from persist_cli.api.ground import ground_axes
from persist_cli.data.storable import MOST_CELLS

Array = np.ndarray[Any, Any]
BYTES = 5  # of a cell: class, origin, red, green, blue
LEVEL = 6  # of zlib


@dataclass(frozen=True)
class CellBox:
    """The box of cells that a whole trajectory has, as its file's header holds it.

    Args:
        form: size and classes of the cells.
        corner: number of the lowest cell along each axis.
        shape: cells along the two ground axes and up.
    """

    form: CellForm
    corner: tuple[int, int, int]
    shape: tuple[int, int, int]

    @staticmethod
    def of(grid: CellGrid) -> CellBox:
        """Return the box of a grid."""
        return CellBox(grid.form, grid.corner, grid.shape)

    def to_json(self) -> dict[str, Any]:
        """Return a JSON object that ``from_json`` reads back."""
        return self.form.to_json() | {"corner": list(self.corner), "shape": list(self.shape)}

    @staticmethod
    def from_json(values: dict[str, Any]) -> CellBox:
        """Return the box that ``to_json`` wrote; ``KeyError``, ``TypeError`` or ``ValueError`` when it is none."""
        form = CellForm(float(values["size"]), tuple(str(name) for name in values["palette"]))
        (a, b, c), (rows, columns, levels) = (tuple(int(n) for n in values[key]) for key in ("corner", "shape"))
        if math.prod((rows, columns, levels)) > MOST_CELLS:
            raise ValueError(f"a box of {rows}×{columns}×{levels} has more than {MOST_CELLS:,} cells")
        if form.size <= 0 or form.palette[: len(COMMON)] != COMMON or min(rows, columns, levels) < 1:
            raise ValueError(f"cells of {form.size:g} m in a box of {rows}×{columns}×{levels} are none")
        return CellBox(form, (a, b, c), (rows, columns, levels))

    def read(self, parts: list[bytes | None], world_up: tuple[float, float, float]) -> CellGrid:
        """Return the grid at a frame.

        Args:
            parts: what ``encode_cells`` gave for every frame up to this one; ``None`` where nothing changed.
            world_up: unit vector that points up in the world.

        Raises:
            ValueError: when a part is damaged or the first one is missing.
        """
        if not parts or parts[0] is None:
            raise ValueError("there are none at the first frame")
        whole = math.prod(self.shape)
        content = _inflate(parts[0], whole * BYTES)
        if len(content) < whole * BYTES:
            raise ValueError(f"{len(content)} bytes are not the {whole * BYTES} of the box")
        rows = content.reshape(BYTES, -1).T.copy()
        for part in parts[1:]:
            if part is not None:
                cells, values = _decode_changes(part, whole)
                if len(cells) and not 0 <= int(cells.min()) <= int(cells.max()) < whole:
                    raise ValueError("a change lies outside of the box")
                rows[cells] = values
        if int(rows[:, 0].max()) >= len(self.form.palette):
            raise ValueError(f"class {int(rows[:, 0].max())} is not in the palette of {len(self.form.palette)}")
        return self._grid(torch.from_numpy(rows), world_up)

    def _grid(self, rows: Tensor, world_up: tuple[float, float, float]) -> CellGrid:
        grid = CellGrid.unknown(self.corner, self.shape, self.form, ground_axes(world_up))
        classes, origins = (rows[:, channel].reshape(self.shape).contiguous() for channel in (0, 1))
        return replace(grid, classes=classes, origins=origins, colors=rows[:, 2:].reshape(*self.shape, 3).contiguous())


def encode_cells(grid: CellGrid, before: CellGrid | None) -> bytes | None:
    """Return what a frame's row stores.

    Args:
        grid: the cells at the frame.
        before: those at the frame before, in the same box; ``None`` at the first frame, which stores all cells.

    Returns:
        The compressed cells, or those that changed; ``None`` when none did.
    """
    rows = _rows(grid)
    if before is None:
        return zlib.compress(rows.T.contiguous().numpy().tobytes(), LEVEL)  # class by class compresses best
    if grid is before:
        return None
    changed = (rows != _rows(before)).any(dim=1).nonzero()[:, 0]
    if not len(changed):
        return None
    cells = changed.numpy().astype("<u4").tobytes()
    return zlib.compress(cells + rows[changed].numpy().tobytes(), LEVEL)


def _rows(grid: CellGrid) -> UInt8[Tensor, "cell 5"]:
    parts = grid.classes.reshape(-1, 1), grid.origins.reshape(-1, 1), grid.colors.reshape(-1, 3)
    return torch.cat(parts, dim=1)


def _decode_changes(part: bytes, most: int) -> tuple[Array, Array]:
    content = _inflate(part, most * (BYTES + 4))
    count, rest = divmod(len(content), BYTES + 4)
    if rest:
        raise ValueError(f"a change of {len(content)} bytes is not whole")
    cells = np.frombuffer(content[: 4 * count].tobytes(), "<u4").astype(np.int64)
    return cells, content[4 * count :].reshape(count, BYTES)


def _inflate(part: bytes, most: int) -> Array:
    """The bytes of a part; ``ValueError`` when it is damaged, or would become more than ``most`` bytes."""
    inflater = zlib.decompressobj()
    try:
        content = inflater.decompress(part, most + 1)  # 1: for 0 means that there is no limit
    except zlib.error as error:
        raise ValueError(str(error)) from error
    if len(content) > most:
        raise ValueError(f"they are more than the {most} bytes of the box")
    if not inflater.eof:
        raise ValueError("they are cut off")
    return np.frombuffer(content, np.uint8)
