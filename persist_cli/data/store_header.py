"""The columns and the header of a trajectory's file."""

from __future__ import annotations

import functools
import json
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from persist_cli.api.actions import ActionVocabulary
from persist_cli.api.cells import CellGrid
from persist_cli.api.observations import TrajectoryInfo
from persist_cli.data.storable import check_info
from persist_cli.data.stored_cells import CellBox
from persist_cli.errors import DataError

FORMAT = "persist-trajectory"
VERSION = 1
METADATA_KEY = b"persist"
IMAGE = pa.struct([pa.field("bytes", pa.binary()), pa.field("path", pa.string())])  # the form of Hugging Face datasets
COLUMNS = pa.schema(
    [
        pa.field("rgb", IMAGE),
        pa.field("depth", IMAGE),
        pa.field("world_from_camera", pa.list_(pa.float64(), 16)),
        pa.field("action", pa.string()),
        pa.field("timestamp", pa.float64()),
    ]
)
CELLS = pa.field("cells", pa.binary())  # an optional column


def schema(info: TrajectoryInfo, cells: CellGrid | None = None) -> pa.Schema:
    """The columns with ``info`` as metadata, in a form that Hugging Face ``datasets`` shows as images.

    Args:
        info: camera, up axis, actions and provenance.
        cells: those of the first frame, where there are any; they get a column, and their box stands in the metadata.
    """
    header = {
        "format": FORMAT,
        "version": VERSION,
        "scene": info.scene,
        "intrinsics": np.asarray(info.intrinsics, dtype=np.float64).tolist(),
        "height": int(info.height),
        "width": int(info.width),
        "world_up": [float(value) for value in info.world_up],
        "vocabulary": info.vocabulary.to_json(),
        "source": info.source,
    }
    columns = COLUMNS
    if cells is not None:
        header["cells"], columns = CellBox.of(cells).to_json(), COLUMNS.append(CELLS)
    header["crc32"] = _header_checksum(header)  # pages have checksums of Parquet's, the metadata has none
    features = _hugging_face_info(cells is not None)
    return columns.with_metadata({METADATA_KEY: json.dumps(header), b"huggingface": json.dumps(features)})


def read_info(metadata: dict[bytes, bytes] | None, path: Path) -> TrajectoryInfo:
    """The ``info`` that ``schema`` put into the metadata of the file ``path``.

    Raises:
        DataError: when the file is of something else, of a newer version, or its header is damaged.
    """
    text = (metadata or {}).get(METADATA_KEY)
    if text is None:
        raise DataError(f"{path}: a Parquet file, but no trajectory of persist (it has no 'persist' metadata)")
    try:
        header = json.loads(text)
        if header["format"] != FORMAT or header["version"] > VERSION:
            raise DataError(
                f"{path}: written as {header['format']} version {header['version']}; "
                f"this persist reads {FORMAT} up to version {VERSION}"
            )
        if "crc32" in header and header["crc32"] != _header_checksum(header):
            raise DataError(f"{path}: its header is damaged, the checksum is wrong; take a whole copy")
        info = _parse_header(header)
        check_info(info, str(path))
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise DataError(f"{path}: its header is damaged ({type(error).__name__}: {error})") from error
    return info


def _header_checksum(header: dict[str, Any]) -> str:
    """CRC-32 of the values of a header but the checksum itself."""
    values = {key: value for key, value in header.items() if key != "crc32"}
    return f"{zlib.crc32(json.dumps(values, sort_keys=True).encode()):08x}"


def _parse_header(header: dict[str, Any]) -> TrajectoryInfo:
    x, y, z = (float(value) for value in header["world_up"])
    return TrajectoryInfo(
        scene=str(header["scene"]),
        intrinsics=np.asarray(header["intrinsics"], dtype=np.float64),
        height=int(header["height"]),
        width=int(header["width"]),
        world_up=(x, y, z),
        vocabulary=_vocabulary(json.dumps(header["vocabulary"])),
        source=dict(header["source"]),
    )


@functools.cache
def _vocabulary(text: str) -> ActionVocabulary:
    """The actions of a header, one object for all trajectories that have the same."""
    return ActionVocabulary.from_json(json.loads(text))


def _hugging_face_info(cells: bool) -> dict[str, Any]:
    double = {"dtype": "float64", "_type": "Value"}
    features = {
        "rgb": {"_type": "Image"},
        "depth": {"_type": "Image"},
        "world_from_camera": {"feature": double, "length": 16, "_type": "Sequence"},
        "action": {"dtype": "string", "_type": "Value"},
        "timestamp": double,
    }
    if cells:
        features[CELLS.name] = {"dtype": "binary", "_type": "Value"}
    return {"info": {"features": features}}
