"""The images of a LeRobot dataset: pictures of videos, or files in a column of Parquet; colours and depth.

Depth in a video is a code of 12 bits, by a logarithm of the distance where the feature does not say otherwise. Code 0
is also what a sensor's missing depth becomes, and the largest code all that is farther than it reaches, so that both
are left out here. Depth in an image is a number of 16 bits in millimetres, or float32 in metres.
"""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow.parquet as pq

from persist_cli.data.importers.lenses import Array, Size
from persist_cli.data.importers.readers import StoredImage, decode_channel, decode_color
from persist_cli.data.importers.videos import TimedPictures
from persist_cli.data.parquet import column, parquet_errors
from persist_cli.errors import DataError, hint

VIDEO: Final = "video"
IMAGE: Final = "image"
BITS: Final = 12  # of depth in a video
LONGEST_SIDE: Final = 2**16  # pixels of an image
FARTHEST: Final = 1e6  # metres that a code may stand for
ROWS: Final = 16  # of images that are read at once
DEPTH: Final = {"depth_min": 0.01, "depth_max": 10.0, "shift": 3.5}  # metres, where the feature does not say
PER_METRE: Final = {"mm": 1000.0, "m": 1.0}
NEAR: Final = 0.4  # of the time between two frames: by so much may a picture's time differ


@dataclass(frozen=True)
class ImageFeature:
    """A feature of images.

    Args:
        key: its name.
        kind: ``VIDEO`` or ``IMAGE``.
        size: of its images.
        is_depth: whether it is marked as depth.
        info: what else is said of it.
    """

    key: str
    kind: str
    size: Size
    is_depth: bool
    info: Mapping[str, Any]

    @staticmethod
    def of(key: str, feature: Mapping[str, Any]) -> ImageFeature:
        """The feature of a dataset's description; ``ValueError`` when it says of no image."""
        info, legacy = feature.get("info") or {}, feature.get("video_info") or {}
        shape = [int(number) for number in feature["shape"]]
        first = len(shape) == 3 and shape[0] in (1, 3) and shape[2] not in (1, 3)  # the channels
        size = tuple(shape[1:] if first else shape[:2])
        if len(shape) not in (2, 3) or not 1 <= min(size) <= max(size) <= LONGEST_SIDE:
            raise ValueError(f"{shape} is the shape of no image")
        is_depth = info.get("is_depth_map") or any(part.get("video.is_depth_map") for part in (info, legacy))
        return ImageFeature(key, feature["dtype"], (size[0], size[1]), bool(is_depth), info)


@dataclass(frozen=True)
class DepthCode:
    """How distances became the codes of a depth video.

    Args:
        nearest: metres of code 0.
        farthest: metres of the largest code.
        shift: metres that are added before the logarithm.
        by_logarithm: whether there is one; else codes are proportional.
    """

    nearest: float
    farthest: float
    shift: float
    by_logarithm: bool

    @staticmethod
    def of(feature: ImageFeature) -> DepthCode:
        """The code of a feature; ``ValueError`` when its numbers are none of a code."""
        nearest, farthest, shift = (float(_given(feature, name, value)) for name, value in DEPTH.items())
        code = DepthCode(nearest, farthest, shift, bool(_given(feature, "use_log", True)))
        has_logarithm = nearest + shift > 0 or not code.by_logarithm
        if not (0 <= nearest < farthest <= FARTHEST and abs(shift) <= FARTHEST and has_logarithm):
            raise ValueError(f"from {nearest:g} to {farthest:g} m with a shift of {shift:g} m")
        return code

    def metres(self, codes: Array) -> Array:
        """Depth, float32 ``[height, width]``, 0 where a code does not tell it, of integers of that shape."""
        largest = 2**BITS - 1
        low, high = self.nearest, self.farthest
        if self.by_logarithm:
            low, high = math.log(low + self.shift), math.log(high + self.shift)
        values = low + codes.astype(np.float64) * (high - low) / largest
        depth = np.exp(values) - self.shift if self.by_logarithm else values
        return np.where((codes > 0) & (codes < largest), depth, 0.0).astype(np.float32)


class VideoImages:
    """The images of a feature that is stored as videos.

    Args:
        feature: the feature.
        as_depth: whether they are depth, else colours.
        rate: frames a second.

    Raises:
        ValueError: when they are said to be depth by a code that is none.
    """

    def __init__(self, feature: ImageFeature, as_depth: bool, rate: float) -> None:
        self.feature, self.rate = feature, rate
        self._code = DepthCode.of(feature) if as_depth else None
        self._pictures = TimedPictures()

    def image(self, path: Path, seconds: float) -> StoredImage:
        """The image at a time of a video."""
        return StoredImage(path, partial(self._read, path, seconds), f"{seconds:.3f} s")

    def _read(self, path: Path, seconds: float) -> Array:
        picture = self._pictures.at(path, seconds, NEAR / self.rate)
        if self._code is None:
            return picture.to_ndarray(format="rgb24")  # type: ignore[no-any-return]
        if (bits := picture.format.components[0].bits) != BITS:
            raise DataError(f"{path}: a picture of {bits} bits a pixel, depth has {BITS}")
        return self._code.metres(picture.to_ndarray(format=f"gray{BITS}le"))


class ColumnImages:
    """The images of a feature that is stored as files in a column of Parquet.

    Args:
        feature: the feature.
        as_depth: whether they are depth, else colours.
    """

    def __init__(self, feature: ImageFeature, as_depth: bool) -> None:
        self.feature = feature
        self._as_depth = as_depth
        self._path: Path | None = None
        self._first, self._files = 0, list[Any]()  # the images of the rows that were read last, and the first's number
        self._batches: Iterator[tuple[int, list[Any]]] = iter(())

    def image(self, path: Path, row: int) -> StoredImage:
        """The image in a row of a file."""
        return StoredImage(path, partial(self._read, path, row), f"row {row}")

    def _read(self, path: Path, row: int) -> Array:
        name = f"{path}: {self.feature.key} of row {row}"
        data = self._file(path, row)
        if not isinstance(data, bytes):
            raise DataError(f"{name} is not in the file")
        return self._depth(decode_channel(data, name), name) if self._as_depth else decode_color(data, name)

    def _depth(self, values: Array, name: str) -> Array:
        unit = self.feature.info.get("depth_unit") or ("mm" if np.issubdtype(values.dtype, np.integer) else "m")
        if unit not in PER_METRE:
            raise DataError(f"{name} is in {unit!r}, neither mm nor m")
        depth = values.astype(np.float32) / np.float32(PER_METRE[unit])
        return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))

    def _file(self, path: Path, row: int) -> bytes | None:
        """What stands for a row's image in the file."""
        if path != self._path or not self._first <= row <= self._first + len(self._files) + ROWS:
            self._files, self._batches = [], self._read_from(path, row)
        self._path = None
        while not self._files or row >= self._first + len(self._files):
            self._first, self._files = next(self._batches, (row, [None]))
        self._path = path
        image = self._files[row - self._first]
        return image.get("bytes") if isinstance(image, dict) else None

    def _read_from(self, path: Path, row: int) -> Iterator[tuple[int, list[Any]]]:
        """The column from the group of a row on, a few rows at once: the number of the first one and what they hold."""
        with parquet_errors(path), pq.ParquetFile(path) as file:
            sizes = [file.metadata.row_group(group).num_rows for group in range(file.num_row_groups)]
            ends = list(itertools.accumulate(sizes))
            group = bisect.bisect_right(ends, row)
            first, groups = sum(sizes[:group]), range(group, len(sizes))
            for batch in file.iter_batches(ROWS, row_groups=groups, columns=[self.feature.key], use_threads=False):
                files = column(batch, self.feature.key, path).to_pylist()
                yield first, files
                first += len(files)


Images = VideoImages | ColumnImages


def image_features(features: Mapping[str, Any], where: str) -> dict[str, ImageFeature]:
    """The features of images among those of a dataset's description.

    Raises:
        DataError: which begins with ``where``, when what is said of one is damaged.
    """
    try:
        return {
            key: ImageFeature.of(key, feature)
            for key, feature in features.items()
            if feature["dtype"] in (IMAGE, VIDEO)
        }
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise DataError(f"{where}: a feature is damaged ({error!r})") from error


def choose_images(features: Mapping[str, ImageFeature], named: str, as_depth: bool, rate: float, where: str) -> Images:
    """The images of the feature that is named, or of the only one that is depth or colours.

    Args:
        features: those of images.
        named: a name; empty for the only one.
        as_depth: whether depth is wanted, else colours.
        rate: frames a second.
        where: what an error begins with.

    Raises:
        DataError: when there is none or several, or the named one is no depth that can be read.
    """
    setting = "depth" if as_depth else "color"
    usual = [key for key, feature in features.items() if feature.is_depth == as_depth]
    if named not in features and (named or len(usual) != 1):
        asked = f"no images {named!r}" if named else f"{len(usual)} features may be the {setting}"
        like = f"; {hint(named, usual, 'there are')}" if usual else ""
        raise DataError(f"{where}: {asked}; give --set {setting}=FEATURE{like}")
    feature = features[named or usual[0]]
    if feature.kind == IMAGE:
        return ColumnImages(feature, as_depth)
    if as_depth and not feature.is_depth:
        raise DataError(f"{where}: the video {feature.key!r} is not marked as depth (is_depth_map)")
    try:
        return VideoImages(feature, as_depth, rate)
    except (OverflowError, TypeError, ValueError) as error:
        raise DataError(f"{where}: {feature.key!r} is no depth that can be read ({error})") from error


def _given(feature: ImageFeature, name: str, default: Any) -> Any:
    """What the feature says of its depth video, by a name."""
    value = feature.info.get(f"video.{name}")
    return default if value is None else value
