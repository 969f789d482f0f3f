"""What a LeRobot dataset says of itself in ``meta/info.json``, and what the user says: which feature is the pose."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from persist_cli.data.importers.captures import OPENCV_FROM_OPENGL, checked_pose, quaternion_pose
from persist_cli.data.importers.lenses import Array
from persist_cli.data.importers.lerobot_images import IMAGE, VIDEO
from persist_cli.data.storable import shown
from persist_cli.errors import DataError, hint
from persist_cli.io.files import read_json

VERSION: Final = "v3."
PLANAR, QUATERNION, MATRIX = 3, 7, 16  # numbers of a pose
MOST_BYTES: Final = 2**25  # of the description
MOST_FEATURES: Final = 1000
MOST_NUMBERS: Final = 2**16  # of a feature along an axis
RATES: Final = (1e-3, 1e5)  # frames a second
FORMS: Final = (PLANAR, QUATERNION, MATRIX)
ROBOT: Final = "robot"
EPISODES: Final = re.compile(r"(?P<first>\d{1,9})(?:-(?P<end>\d{1,9}))?")
ROBOT_FROM_OPENCV: Final = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


@dataclass(frozen=True)
class LeRobotSettings:
    """What the features of a dataset mean.

    Args:
        pose: the feature of the pose in the world: ``x, y, z, qx, qy, qz, qw``; or ``x, y, yaw`` of a robot on a floor,
            in radians to the left; or the 16 numbers of a matrix, row by row.
        names: which of the feature's numbers these are, by their names in this order; all of them when empty.
        axes: what has this pose: a camera with axes as OpenCV's or OpenGL's has them, or a ``robot``, whose x points
            ahead, y left and z up.
        mount: where the robot's camera is: metres ahead, left and up of the robot's origin, and the degrees by which it
            looks up.
        color: the feature of the colours; the only one that is no depth when empty.
        depth: the feature of the depth; the only one when empty.
        scene: whether all episodes show one scene, ``dataset``, or each one of its own, ``episode``.
        episodes: which are read: one, ``7``, or from the first to before the last, ``0-50``; all when empty.
    """

    pose: str = ""
    names: tuple[str, ...] = ()
    axes: Literal["opencv", "opengl", "robot"] = "opencv"
    mount: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    color: str = ""
    depth: str = ""
    scene: Literal["dataset", "episode"] = "dataset"
    episodes: str | int = ""

    def chosen_episodes(self) -> range | None:
        """The numbers of the episodes to read, ``None`` for all.

        Raises:
            DataError: when they are no numbers.
        """
        if self.episodes == "":
            return None
        match = EPISODES.fullmatch(str(self.episodes))
        if match is None:
            raise DataError(f"episodes: {self.episodes!r} is neither a number nor a range as in 0-50")
        first = int(match["first"])
        return range(first, int(match["end"]) if match["end"] else first + 1)


@dataclass(frozen=True)
class PoseFeature:
    """The feature of the pose.

    Args:
        key: its name.
        count: how many numbers it has.
        numbers: which of these are the pose, in order.
        body_from_camera: ``[4, 4]``, of what has this pose.
    """

    key: str
    count: int
    numbers: Sequence[int]
    body_from_camera: Array

    @staticmethod
    def of(features: Mapping[str, Any], settings: LeRobotSettings, where: str) -> PoseFeature:
        """The one that the settings name.

        Raises:
            DataError: which begins with ``where``, when there is none, or it holds no pose.
        """
        key, fit = settings.pose, [name for name, feature in features.items() if _count(feature) in FORMS]
        if key not in features:
            asked = f"no feature {key!r}" if key else "nothing says which feature is the pose"
            like = hint(key, fit, "of 3, 7 or 16 numbers are") if fit else "none has 3, 7 or 16 numbers"
            raise DataError(f"{where}: {asked}; give --set pose=FEATURE; {like}")
        names = _names(features[key])
        if missing := [name for name in settings.names if name not in names]:
            raise DataError(f"{where}: {key!r} has no number {missing[0]!r}; {hint(missing[0], names, 'it has')}")
        count = _count(features[key])
        numbers = [names.index(name) for name in settings.names] or range(count)
        if len(numbers) not in FORMS:
            raise DataError(
                f"{where}: {len(numbers)} numbers of {key!r}, a pose has 3, 7 or 16; --set names=[…] picks some"
            )
        if len(numbers) == PLANAR and settings.axes != ROBOT:
            raise DataError(f"{where}: x, y and yaw are of a robot; give --set axes={ROBOT}")
        if any(settings.mount) and settings.axes != ROBOT:
            raise DataError(f"mount: is of a robot's camera; give --set axes={ROBOT}")
        if not np.isfinite(settings.mount).all():
            raise DataError(f"mount: {list(settings.mount)} are not four finite numbers")
        camera = {"opencv": np.eye(4), "opengl": OPENCV_FROM_OPENGL, ROBOT: _camera_of_robot(settings.mount)}
        return PoseFeature(key, count, numbers, camera[settings.axes])

    def poses(self, values: Sequence[Any], where: str) -> list[Array | DataError]:
        """world_from_camera ``[4, 4]`` of each frame, or why it cannot be used.

        Args:
            values: the feature's numbers of each frame, as lists.
            where: what an error begins with.

        Raises:
            DataError: when they are not as many numbers as the dataset says.
        """
        try:
            numbers = np.array(values, dtype=np.float64).reshape(len(values), self.count)[:, self.numbers]
        except (IndexError, OverflowError, TypeError, ValueError) as error:
            raise DataError(f"{where}: {self.key!r} does not hold the numbers that it should ({error})") from error
        poses = [_pose(row, f"{where}, frame {number}") for number, row in enumerate(numbers.tolist())]
        return [pose if isinstance(pose, DataError) else pose @ self.body_from_camera for pose in poses]


def read_info(path: Path) -> dict[str, Any]:
    """The values of ``meta/info.json``, with ``fps`` as a number above 0 and a dictionary of ``features``.

    Raises:
        DataError: when it is missing or damaged, or of another version.
    """
    if path.exists() and (not path.is_file() or path.stat().st_size > MOST_BYTES):
        raise DataError(f"{path}: not a file of {MOST_BYTES // 2**20} MB at most, as of a LeRobot dataset")
    info = read_json(path, DataError)
    version = info.get("codebase_version") if isinstance(info, dict) else None
    if not str(version).startswith(VERSION):
        raise DataError(
            f"{path}: of version {shown(version)}; {VERSION}0 and later are read, to which LeRobot converts others"
        )
    rate, features = info.get("fps"), info.get("features")
    if not isinstance(rate, int | float) or not RATES[0] <= rate <= RATES[1] or not isinstance(features, dict):
        raise DataError(f"{path}: no frames a second, or no features")
    if len(features) > MOST_FEATURES:
        raise DataError(f"{path}: {len(features)} features, a dataset has {MOST_FEATURES} at most")
    return info  # type: ignore[no-any-return]


def _pose(numbers: Sequence[float], where: str) -> Array | DataError:
    """The pose ``[4, 4]`` of so many numbers as ``FORMS`` has, or the error, which begins with ``where``."""
    if len(numbers) == QUATERNION:
        return quaternion_pose(numbers, where)
    if len(numbers) == PLANAR:
        x, y, yaw = numbers
        return quaternion_pose([x, y, 0.0, 0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)], where)
    try:
        return checked_pose(np.array(numbers).reshape(4, 4), where)
    except DataError as error:
        return error


def _camera_of_robot(mount: tuple[float, float, float, float]) -> Array:
    """robot_from_camera ``[4, 4]`` of a camera that looks ahead, up by the last number in degrees."""
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_euler("y", -mount[3], degrees=True).as_matrix()
    turned[:3, 3] = mount[:3]
    return np.asarray(turned @ ROBOT_FROM_OPENCV)


def _count(feature: Any) -> int:
    """How many numbers a feature has in a frame; 0 where it is none of numbers."""
    shape = feature.get("shape") if isinstance(feature, dict) else None
    if not isinstance(shape, list) or len(shape) > 2 or feature.get("dtype") in (IMAGE, VIDEO, "string"):
        return 0
    return math.prod(number if isinstance(number, int) and 0 < number <= MOST_NUMBERS else 0 for number in shape)


def _names(feature: Mapping[str, Any]) -> list[str]:
    """The names of a feature's numbers, in order, of which LeRobot's robots give lists, or their places by name."""
    names = feature.get("names") or []
    if isinstance(names, dict) and sorted(names.values(), key=str) == sorted(range(len(names)), key=str):
        return sorted(names, key=names.__getitem__)
    groups = names.values() if isinstance(names, dict) else [names]
    return [str(name) for group in groups if isinstance(group, list) for name in group]
