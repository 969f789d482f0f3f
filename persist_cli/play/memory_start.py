"""A start in a memory file, where no frame was observed: what the memory holds is drawn as the first frame.

A walk begins where the last path of the file ends, since something is known around it. In a file without paths, such as
one that was made in Python, it begins on the ground that is farthest from all that is in the way.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from persist_cli.api.actions import walking_actions
from persist_cli.api.cameras import Cameras
from persist_cli.api.geometry import project
from persist_cli.api.ground import Body, Cover, GroundMap, ground_axes
from persist_cli.api.memory import MapPoints, Memory
from persist_cli.api.observations import Observations, Origin, Trajectory, TrajectoryInfo
from persist_cli.errors import DataError
from persist_cli.memorize.memory_file import load_memory, load_paths
from persist_cli.memorize.picture import FIELD_OF_VIEW
from persist_cli.navigation.ground_mapper import GroundMapper
from persist_cli.navigation.routes import squares_apart
from persist_cli.play.ground import turned

LOWEST: Final = 0.02  # share of the points below the floor's height, which are noise
HEIGHTS: Final = (0.3, 2.5)  # metres of a camera above the floor that can be a walker's
NEAREST: Final = 0.1  # metres before the camera at which points begin to be drawn
LARGEST: Final = 6  # a point is drawn as 2 to the power of 6 pixels at most
HEADINGS: Final = 12  # directions that are compared in a file without paths


def memory_start(path: Path, image_size: tuple[int, int], fov: tuple[float, float] | None) -> Trajectory:
    """Return the start in a memory file, a single imagined frame.

    Args:
        path: the file.
        image_size: height and width in pixels that the model takes.
        fov: least and greatest degrees of view, from top to bottom, that the model was trained with; ``None`` if
            unknown.

    Raises:
        PersistError: when the file is missing, damaged, or holds no places.
    """
    memory, paths = load_memory(path), load_paths(path)
    points = memory.points()
    if not len(points.positions):
        raise DataError(f"--start {path}: holds no places to stand at; begin at a frame, DATA#trajectory:frame")
    axes = ground_axes(memory.reference.world_up)
    heights = points.positions.cpu().double() @ axes[2]
    floor = float(heights.quantile(LOWEST)) if len(heights) < 1_000_000 else float(heights[::16].quantile(LOWEST))
    body = Body()
    if paths:
        pose = list(paths.values())[-1][-1].double()
        above = float(axes[2] @ pose[:3, 3]) - floor
        body = Body(camera_height=above) if HEIGHTS[0] <= above <= HEIGHTS[1] else body
    else:
        pose = _open_ground(memory, floor, body, path)
    info = _info(memory, image_size, FIELD_OF_VIEW if fov is None else sum(fov) / 2, body)
    matrix = torch.from_numpy(info.intrinsics)
    frame = drawn_points(points, Cameras(pose[None], matrix[None], info.height, info.width))
    return Trajectory(path.stem, frame, (None,), info)


def drawn_points(points: MapPoints, camera: Cameras) -> Observations:
    """Return what a camera sees of points, each a square of its spread, as an imagined frame; black where none is.

    Args:
        points: of a memory.
        camera: with a frame axis of one.
    """
    (pixels,), (depth,) = project(points.positions.cpu().double()[None], camera)
    sizes = float(camera.intrinsics[0, 0, 0]) * points.spread / depth.clamp_min(NEAREST)
    levels = sizes.log2().ceil().clamp(0, LARGEST).long()
    inside = (depth > NEAREST) & (pixels >= 0).all(1) & (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
    rgb = torch.zeros(camera.height, camera.width, 3, dtype=torch.uint8)
    nearest = torch.full((camera.height, camera.width), math.inf, dtype=torch.float64)
    colors = points.colors.cpu()
    for level in levels[inside].unique().tolist():
        here = inside & (levels == level)
        found, away = _nearest(pixels[here], depth[here], 1 << level, camera)
        shown = away < nearest
        rgb[shown], nearest[shown] = colors[here][found[shown]], away[shown]
    metres = torch.where(nearest.isfinite(), nearest, 0.0).float()
    return Observations(rgb[None], metres[None], camera).with_origin(Origin.IMAGINED)


def _nearest(
    pixels: Float[Tensor, "point 2"], depth: Float[Tensor, " point"], side: int, camera: Cameras
) -> tuple[Tensor, Float[Tensor, "height width"]]:
    """Return for each pixel the nearest point in its square of ``side`` pixels, and its depth; infinite without one."""
    columns, rows = -(-camera.width // side), -(-camera.height // side)
    column, row = (pixels / side).floor().long().unbind(1)
    squares = row * columns + column
    away = torch.full((rows * columns,), math.inf, dtype=torch.float64).scatter_reduce(0, squares, depth, "amin")
    found = torch.zeros(rows * columns, dtype=torch.int64)
    winners = (depth == away[squares]).nonzero()[:, 0]
    found[squares[winners]] = winners

    def enlarged(image: Tensor) -> Tensor:
        large = image.reshape(rows, columns).repeat_interleave(side, 0).repeat_interleave(side, 1)
        return large[: camera.height, : camera.width]

    return enlarged(found), enlarged(away)


def _info(memory: Memory, size: tuple[int, int], fov: float, body: Body) -> TrajectoryInfo:
    """Return the world of a memory, seen by a camera of the model's size."""
    height, width = size
    focal = height / 2 / math.tan(math.radians(fov) / 2)
    matrix = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
    source = {"format": "memory", "memory": memory.name, "camera_height": body.camera_height}
    reference = memory.reference
    up, vocabulary = reference.world_up, walking_actions()
    return TrajectoryInfo(reference.name, matrix.numpy(), height, width, up, vocabulary, source)


def _open_ground(memory: Memory, floor: float, body: Body, path: Path) -> Float[Tensor, "4 4"]:
    """Return the pose on free ground that is farthest from what is in the way, which looks where it is open longest."""
    mapper = GroundMapper(memory.reference.world_up, body)
    mapper.add_memory(memory, floor)
    ground = mapper.map()
    free = ground.states == Cover.FREE
    if not bool(free.any()):
        raise DataError(f"--start {path}: no free ground is known in it; begin at a frame, DATA#trajectory:frame")
    apart = torch.where(free, squares_apart(~free), 0.0)
    row, column = divmod(int(apart.argmax()), apart.shape[1])
    place = torch.tensor(ground.origin, dtype=torch.float64) + (torch.tensor([column, row]) + 0.5) * ground.spacing
    pose = torch.eye(4, dtype=torch.float64)
    right, ahead, up = ground.axes
    pose[:3, :3] = torch.stack([right, -up, ahead], dim=1)  # level, along the second ground axis
    pose[:3, 3] = torch.cat([place, place.new_tensor([floor + body.camera_height])]) @ ground.axes
    headings = [360.0 * number / HEADINGS - 180 for number in range(HEADINGS)]
    best = max(headings, key=lambda degrees: _open_metres(ground, place, degrees))
    info = _info(memory, (1, 1), FIELD_OF_VIEW, body)
    return turned(pose, best, info)


def _open_metres(ground: GroundMap, place: Float[Tensor, " 2"], degrees: float) -> float:
    """Return how far the ground is free in a direction, metres."""
    angle = math.radians(degrees)
    steps = torch.arange(1, 200, dtype=torch.float64) * ground.spacing
    way = place + steps[:, None] * torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
    closed = (ground.at(way) != Cover.FREE).nonzero()
    return float(steps[int(closed[0])]) if len(closed) else float(steps[-1])
