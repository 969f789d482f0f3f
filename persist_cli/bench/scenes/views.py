"""Single images of held-out houses: what is known of the cells around the camera after one image, and what is true."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from persist_cli.api.cells import OUTSIDE, Box, CellForm, CellGrid
from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.errors import DataError


@dataclass(frozen=True)
class Region:
    """A square block of cells around a camera, from the lowest to the highest level of a house.

    Args:
        corner: number of its lowest cell.
        shape: cells along the two ground axes and up; the first two are equal and odd, the camera's cell is in the
            middle.
        quarter: the camera's heading as a number of quarter turns from the first ground axis towards the second.
    """

    corner: tuple[int, int, int]
    shape: tuple[int, int, int]
    quarter: int

    @staticmethod
    def around(grid: CellGrid, world_from_camera: Float[Tensor, "4 4"], radius: float) -> Region:
        """Return the region around a camera.

        Args:
            grid: all levels of this grid are taken.
            world_from_camera: pose, OpenCV axes, metres.
            radius: metres from the camera to the region's sides.
        """
        first, second, _ = grid.numbers(world_from_camera[:3, 3]).tolist()
        reach = math.ceil(radius / grid.form.size)
        forward = (grid.axes @ world_from_camera[:3, 2].double()).tolist()
        quarter = round(math.atan2(forward[1], forward[0]) / (math.pi / 2)) % 4
        side = 2 * reach + 1
        return Region((first - reach, second - reach, grid.corner[2]), (side, side, grid.shape[2]), quarter)

    def of(self, grid: CellGrid) -> CellGrid:
        """Return the region's cells of a grid, a copy; those outside of the grid are unknown."""
        return grid.box(self.corner, self.shape)

    def box(self, grid: CellGrid) -> Box:
        """Return the region as a box of the world in which ``grid`` lies."""
        centers = CellGrid.unknown(self.corner, self.shape, grid.form, grid.axes).centers().reshape(-1, 3)
        (low, high) = centers.amin(0).tolist(), centers.amax(0).tolist()
        return Box((low[0], low[1], low[2]), (high[0], high[1], high[2]))

    def ahead(self, values: Tensor) -> Tensor:
        """Turn ``[first, second, ...]`` of the region by quarter turns, so that the camera looks along the first axis.

        The region is square and the camera in its middle, so that it stays there.
        """
        return torch.rot90(values, -self.quarter, (0, 1))

    def back(self, values: Tensor) -> Tensor:
        """Undo ``ahead``."""
        return torch.rot90(values, self.quarter, (0, 1))


@dataclass(frozen=True, kw_only=True)
class View:
    """One image of a held-out house.

    Args:
        name: of the trajectory, with the frame.
        scene: name of the house.
        info: of the trajectory.
        frame: the image with depth and pose, one frame.
        region: what is completed.
        known: the region's cells after the image was written into an empty scene.
        truth: the region's true cells, every one known.
        near: which cells of the region are measured when they are not known.
        house: all true cells of the house.
        sha256: of the file that it was read from.
    """

    name: str
    scene: str
    info: TrajectoryInfo
    frame: Observations
    region: Region
    known: CellGrid
    truth: CellGrid
    near: Bool[Tensor, "first second level"]
    house: CellGrid
    sha256: str = ""

    @property
    def unseen(self) -> Bool[Tensor, "first second level"]:
        """Which cells are measured: unknown after the image, and near."""
        return self.near & ~self.known.known


def true_region(cells: CellGrid, region: Region) -> CellGrid:
    """Return the true cells of a region; beyond a house's own cells all is outside."""
    truth = region.of(cells)
    truth.classes[~truth.known] = OUTSIDE
    truth.origins[:] = truth.origins.clamp_min(1)
    return truth


def near_camera(grid: CellGrid, center: Float[Tensor, " 3"], radius: float) -> Bool[Tensor, "first second level"]:
    """Return which cells' middles lie within a radius in metres of a camera, along the ground."""
    away = (grid.centers() - center.double()) @ grid.axes.T
    near: Bool[Tensor, "first second level"] = away[..., :2].norm(dim=-1) <= radius
    return near


def same_form(grid: CellGrid, form: CellForm, what: str) -> CellGrid:
    """Return a grid whose classes are those of a form.

    A grid whose palette is shorter may be of the same names as far as they go, as that of a scene without a model is.

    Raises:
        DataError: when the cells have another size, or the palettes differ.
    """
    palette = grid.form.palette
    if grid.form.size != form.size:
        raise DataError(f"{what} has cells of {grid.form.size:g} m, the data's are {form.size:g} m")
    if palette != form.palette[: len(palette)]:
        pairs = zip(palette, (*form.palette, *["nothing"] * len(palette)), strict=False)
        ours, theirs = next(pair for pair in pairs if pair[0] != pair[1])
        raise DataError(f"{what} has a class {ours!r} where the data have {theirs!r}; take data of its own classes")
    return replace(grid, form=form)


def filled(known: CellGrid, classes: UInt8[Tensor, "first second level"]) -> CellGrid:
    """Return known cells as they are, and all others imagined with these classes."""
    result, unknown = known.copy(), ~known.known
    result.classes[unknown] = classes[unknown]
    result.origins[unknown] = 1
    return result


def sampled(
    view: View, classes: UInt8[Tensor, "first second level"], known: Bool[Tensor, "first second level"]
) -> CellGrid:
    """Return a view's region with the classes of a sample, observed where the image shows the cell.

    Args:
        view: an image.
        classes: of all cells; those of observed ones say what a model sees in them.
        known: which cells the sample has.
    """
    origins = torch.where(view.known.known, view.known.origins, known.to(torch.uint8))
    return replace(view.known, classes=classes, origins=origins)
