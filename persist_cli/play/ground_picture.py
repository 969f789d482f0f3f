"""The map that grows while one walks: what is remembered, seen from above, with the way.

Unlike the maps of ``output.map`` it is drawn in milliseconds, also of a million points, and without axes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from jaxtyping import Float, Int64, UInt8
from PIL import Image, ImageDraw
from torch import Tensor

from persist_cli.api.cells import CellOrigin
from persist_cli.api.ground import Cover, GroundMap
from persist_cli.api.memory import MapPoints
from persist_cli.output.map import ABOVE_CAMERA, LEAST_SPREAD, PATH_COLORS, UNSEEN, hatched
from persist_cli.play.settings import GroundPose

MARGIN: Final = 0.5  # metres around all that is drawn
LEAST: Final = 4.0  # metres of the shorter side at least, so that a single point does not fill the picture
MOST_SQUARES: Final = 1200  # along the longer side; smaller points share a square
COVER_COLORS: Final = {Cover.FREE: (255, 255, 255), Cover.OCCUPIED: (90, 90, 90)}
WAY_COLOR, HOME_COLOR, GOAL_COLOR = PATH_COLORS[0], PATH_COLORS[1], PATH_COLORS[2]

Places = Float[Tensor, "place 2"]  # on the ground axes, metres


@dataclass(frozen=True)
class Extent:
    """The part of the ground that a picture shows, metres on the ground axes."""

    left: float
    bottom: float
    right: float
    top: float

    @staticmethod
    def around(places: Places) -> Extent:
        """Return the part around some places."""
        low, high = places.amin(0) - MARGIN, places.amax(0) + MARGIN
        missing = (LEAST - (high - low)).clamp_min(0) / 2
        (left, bottom), (right, top) = (low - missing).tolist(), (high + missing).tolist()
        return Extent(left, bottom, right, top)

    @staticmethod
    def at(corner: Float[Tensor, " 2"], side: float, columns: int, rows: int) -> Extent:
        """Return the part that so many squares of a side cover from their lowest corner on."""
        left, bottom = corner.tolist()
        return Extent(left, bottom, left + columns * side, bottom + rows * side)

    @property
    def sides(self) -> tuple[float, float]:
        """Width and height."""
        return self.right - self.left, self.top - self.bottom


@dataclass(frozen=True)
class Backdrop:
    """Squares seen from above, in their colours.

    Args:
        image: RGB, the first row at the top.
        extent: what it shows.
    """

    image: UInt8[np.ndarray, "row column 3"]
    extent: Extent


@dataclass(frozen=True)
class GroundPicture:
    """A map from above.

    Args:
        picture: RGB, 0…255, the first row at the top.
        extent: metres on the ground axes at its left, bottom, right and top.
    """

    picture: UInt8[Tensor, "height width 3"]
    extent: tuple[float, float, float, float]


def backdrop_of_points(points: MapPoints, axes: Float[Tensor, "3 3"], camera_height: float) -> Backdrop:
    """Return the points of a memory from above, each square in the colour of its highest one below the ceiling.

    Observed points are drawn over imagined ones, and what is imagined is pale with stripes.

    Args:
        points: at least one.
        axes: rows are the two ground axes and up.
        camera_height: of the camera along up, metres; what is higher is cut away.
    """
    positions = points.positions.detach().cpu().double() @ axes.T
    shown = positions[:, 2] <= camera_height + ABOVE_CAMERA
    if not bool(shown.any()):
        shown[:] = True
    positions, colors, origins = positions[shown], points.colors.cpu()[shown], points.origins.cpu()[shown]
    low, high = positions[:, :2].amin(0), positions[:, :2].amax(0)
    side = max(points.spread, LEAST_SPREAD, float((high - low).max()) / MOST_SQUARES)
    places = ((positions[:, :2] - low) / side + 0.5).floor().long()
    columns, rows = (places.amax(0) + 1).tolist()
    squares = places[:, 1] * columns + places[:, 0]
    top = _topmost(squares, positions[:, 2] + 1e4 * (origins != CellOrigin.IMAGINED), rows * columns)
    image = np.zeros((rows * columns, 5))
    image[squares[top].numpy(), :3] = colors[top].numpy() / 255.0
    image[squares[top].numpy(), 3] = 1.0
    image[squares[top].numpy(), 4] = origins[top].numpy()
    extent = Extent.at(low - side / 2, side, columns, rows)
    return Backdrop(_opaque(hatched(image.reshape(rows, columns, 5))), extent)


def backdrop_of_ground(ground: GroundMap) -> Backdrop | None:
    """Return what is known to be free and occupied, where a memory has no points; ``None`` where nothing is."""
    if not bool((ground.states != Cover.UNKNOWN).any()):
        return None
    rows, columns = ground.states.shape
    image = np.empty((rows, columns, 3), np.uint8)
    image[:] = np.round(np.array(UNSEEN[:3]) * 255)
    for cover, color in COVER_COLORS.items():
        image[(ground.states == cover).numpy()] = color
    extent = Extent.at(torch.tensor(ground.origin, dtype=torch.float64), ground.spacing, columns, rows)
    return Backdrop(np.ascontiguousarray(image[::-1]), extent)


@dataclass(frozen=True)
class Marks:
    """What is drawn over the ground.

    Args:
        agent: where it stands. The picture reaches there; the page draws the agent, which moves between two maps.
        home: where it began.
        way: where it was, lines between places that belong together.
        goal: place of the goal; ``None`` without one.
    """

    agent: GroundPose
    home: GroundPose
    way: Sequence[Sequence[tuple[float, float]]]
    goal: tuple[float, float] | None = None

    def places(self) -> list[tuple[float, float]]:
        """Return all places that the picture has to show."""
        named = [(pose.x, pose.y) for pose in (self.agent, self.home)]
        return [*named, *([self.goal] if self.goal else []), *(place for part in self.way for place in part)]


def draw_ground(backdrop: Backdrop | None, marks: Marks, size: int) -> GroundPicture:
    """Return a picture of the ground and the marks, whose longer side has ``size`` pixels."""
    places = torch.tensor(marks.places(), dtype=torch.float64)
    if backdrop is not None:
        e = backdrop.extent
        inner = torch.tensor([[e.left, e.bottom], [e.right, e.top]], dtype=torch.float64)
        places = torch.cat([places, inner])
    extent = Extent.around(places)
    scale = size / max(extent.sides)
    width, height = (max(1, round(side * scale)) for side in extent.sides)
    image = Image.new("RGB", (width, height), tuple(round(255 * part) for part in UNSEEN[:3]))
    if backdrop is not None:
        left, top = _pixel(extent, scale, (backdrop.extent.left, backdrop.extent.top))
        right, bottom = _pixel(extent, scale, (backdrop.extent.right, backdrop.extent.bottom))
        box = [round(left), round(top), max(round(right), round(left) + 1), max(round(bottom), round(top) + 1)]
        smaller = backdrop.image.shape[1] > box[2] - box[0]
        kind = Image.Resampling.BOX if smaller else Image.Resampling.NEAREST
        image.paste(Image.fromarray(backdrop.image).resize((box[2] - box[0], box[3] - box[1]), kind), (box[0], box[1]))
    _draw_marks(ImageDraw.Draw(image), marks, extent, scale)
    return GroundPicture(torch.from_numpy(np.array(image)), (extent.left, extent.bottom, extent.right, extent.top))


def _draw_marks(draw: ImageDraw.ImageDraw, marks: Marks, extent: Extent, scale: float) -> None:
    for part in marks.way:
        if len(part) > 1:
            draw.line([_pixel(extent, scale, place) for place in part], fill=WAY_COLOR, width=2)
    x, y = _pixel(extent, scale, (marks.home.x, marks.home.y))
    draw.rectangle([x - 4, y - 4, x + 4, y + 4], outline="white", fill=HOME_COLOR)
    if marks.goal is not None:
        x, y = _pixel(extent, scale, marks.goal)
        draw.ellipse([x - 6, y - 6, x + 6, y + 6], outline="black", fill=GOAL_COLOR)


def _pixel(extent: Extent, scale: float, place: tuple[float, float]) -> tuple[float, float]:
    return (place[0] - extent.left) * scale, (extent.top - place[1]) * scale


def _topmost(squares: Int64[Tensor, " point"], ranks: Float[Tensor, " point"], count: int) -> Int64[Tensor, " square"]:
    """Return for each square that has a point the point of the highest rank."""
    highest = torch.full((count,), -math.inf, dtype=torch.float64).scatter_reduce(0, squares, ranks, "amax")
    return (ranks == highest[squares]).nonzero()[:, 0]


def _opaque(rgba: np.ndarray) -> UInt8[np.ndarray, "row column 3"]:
    """Return RGBA in 0…1, the lowest row first, over the colour of what is not seen, the first row at the top."""
    seen = rgba[..., 3:4]
    image = rgba[..., :3] * seen + np.array(UNSEEN[:3]) * (1 - seen)
    return np.ascontiguousarray(np.round(255 * image[::-1]).astype(np.uint8))
