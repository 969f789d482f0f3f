"""What a trajectory's file can hold; it is checked before it is written, and what plugins give before it is used."""

from __future__ import annotations

import json
import math
import numbers
from typing import Any

import numpy as np
import torch

from persist_cli.api.actions import Action, ActionVocabulary
from persist_cli.api.cameras import check_intrinsics, check_pose
from persist_cli.api.cells import CellGrid
from persist_cli.api.observations import Frame, TrajectoryInfo
from persist_cli.errors import DataError

MOST_CELLS = 2**27  # of a scene's box: 671 MB of cells

LONGEST = 60  # characters of a wrong value in a message


def shown(value: Any) -> str:
    """A wrong value in a message: one line, shortened."""
    text = " ".join(repr(value).split())
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}…"


def are_numbers(value: Any, shape: tuple[int, ...]) -> bool:
    """Whether something is finite numbers in this shape."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        return False
    return array.shape == shape and bool(np.isfinite(array).all())


def check_info(info: TrajectoryInfo, where: str) -> None:
    """Raise ``DataError``, which begins with ``where``, unless what all frames share can be stored."""
    if not isinstance(info, TrajectoryInfo):
        raise DataError(f"{where}: its info is {shown(info)}, no TrajectoryInfo")
    if not isinstance(info.scene, str):
        raise DataError(f"{where}: its scene is {shown(info.scene)}, not a name")
    if not all(isinstance(side, numbers.Integral) for side in (info.height, info.width)):
        raise DataError(f"{where}: an image size of {shown((info.height, info.width))} is not two whole numbers")
    if info.height < 1 or info.width < 1:
        raise DataError(f"{where}: an image size of {info.height}×{info.width} is none")
    _check_intrinsics(info.intrinsics, where)
    if not are_numbers(info.world_up, (3,)) or not abs(float(np.linalg.norm(info.world_up)) - 1) < 1e-3:
        raise DataError(f"{where}: world_up {shown(info.world_up)} is not a unit vector of three numbers")
    _check_vocabulary(info.vocabulary, where)
    if not isinstance(info.source, dict):
        raise DataError(f"{where}: its source is {shown(info.source)}, not a dictionary")
    try:
        json.dumps(info.source)
    except (TypeError, ValueError) as error:
        raise DataError(f"{where}: its source must hold values of JSON ({error})") from error


def check_given_frame(frame: Frame, info: TrajectoryInfo, where: str) -> None:
    """Raise ``DataError`` as ``check_frame`` does, and also for a pose that is not rigid, at the border of a plugin."""
    check_frame(frame, info, where)
    check_pose(torch.from_numpy(frame.world_from_camera.astype(np.float64)), where)


def check_frame(frame: Frame, info: TrajectoryInfo, where: str) -> None:
    """Raise ``DataError``, which begins with ``where``, unless images, pose, action, time and cells can be stored.

    Whether poses are rigid is checked of all frames at once, which takes less time: by ``check_poses``.

    Args:
        frame: its depth may have any values.
        info: what all frames of its trajectory share.
        where: names the frame.
    """
    size = (info.height, info.width)
    rgb, depth, pose = (_array(frame, name, where) for name in ("rgb", "depth", "world_from_camera"))
    if rgb.shape != (*size, 3) or rgb.dtype != np.uint8:
        raise DataError(f"{where}: rgb is {rgb.dtype} {list(rgb.shape)}, not uint8 {[*size, 3]}")
    if depth.shape != size or not np.issubdtype(depth.dtype, np.floating):
        raise DataError(f"{where}: depth is {depth.dtype} {list(depth.shape)}, not floating-point metres {list(size)}")
    if pose.shape != (4, 4) or pose.dtype.kind not in "fiu":
        raise DataError(f"{where}: the pose has shape {list(pose.shape)} of {pose.dtype}, not [4, 4] of numbers")
    if not (frame.action is None or isinstance(frame.action, str)):
        raise DataError(f"{where}: its action is {shown(frame.action)}, not a name or None")
    if not isinstance(frame.timestamp, numbers.Real) or not math.isfinite(frame.timestamp):
        raise DataError(f"{where}: its timestamp is {shown(frame.timestamp)}, not a finite number of seconds")
    if not (frame.cells is None or isinstance(frame.cells, CellGrid)):
        raise DataError(f"{where}: its cells are {shown(frame.cells)}, no CellGrid")
    if frame.cells is not None and math.prod(frame.cells.shape) > MOST_CELLS:
        raise DataError(f"{where}: its box has {math.prod(frame.cells.shape):,} cells, more than {MOST_CELLS:,}")


def _array(frame: Frame, name: str, where: str) -> np.ndarray[Any, Any]:
    array = getattr(frame, name)
    if not isinstance(array, np.ndarray):
        raise DataError(f"{where}: {name} is {shown(array)}, no array of numpy")
    return array


def _check_intrinsics(matrix: Any, where: str) -> None:
    try:
        intrinsics = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(f"{where}: the intrinsics are {shown(matrix)}, no matrix of numbers") from error
    if intrinsics.shape != (3, 3):
        raise DataError(f"{where}: the intrinsics have shape {list(intrinsics.shape)}, not [3, 3]")
    check_intrinsics(torch.from_numpy(intrinsics), where)


def _check_vocabulary(vocabulary: Any, where: str) -> None:
    actions = vocabulary.actions if isinstance(vocabulary, ActionVocabulary) else None
    if not isinstance(actions, tuple) or not all(isinstance(action, Action) for action in actions):
        raise DataError(f"{where}: its vocabulary is {shown(vocabulary)}, no ActionVocabulary with a tuple of Actions")
    for action in actions:
        if not isinstance(action.name, str):
            raise DataError(f"{where}: an action of its vocabulary is named {shown(action.name)}, which is no name")
        sizes = action.forward, action.turn
        if not all(isinstance(size, int | float) and math.isfinite(size) for size in sizes):
            raise DataError(
                f"{where}: the action {action.name!r} has forward {shown(sizes[0])} and turn {shown(sizes[1])}; "
                "give metres and degrees as finite numbers of Python"
            )
    if len(set(vocabulary.names)) < len(actions):
        raise DataError(f"{where}: its vocabulary has two actions of one name ({', '.join(vocabulary.names)})")
