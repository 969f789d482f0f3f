"""A binary glTF mesh of the faces of blocks that can be seen, each in one colour that says which way it looks."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from persist_cli.viewer.drawn_cells import DrawnCells

Array = np.ndarray[Any, Any]

FACES: Final = ((0, -1), (0, 1), (1, -1), (1, 1), (2, -1), (2, 1))  # axis and side
SHADES: Final = (0.8, 0.8, 0.9, 0.9, 0.65, 1.0)  # of these faces: a top is bright, an underside dark
FLOAT, UNSIGNED_SHORT, UNSIGNED_INT = 5126, 5123, 5125  # component types of glTF
UNLIT: Final = "KHR_materials_unlit"


def block_mesh(parts: Sequence[tuple[DrawnCells, Array]]) -> tuple[bytes, Array]:
    """Return a GLB file of blocks without lights, and the place ``[3]`` that its coordinates are relative to.

    A face between two blocks of one width is left out. Coordinates are world metres less that place, so that they keep
    their precision in 32 bits.

    Args:
        parts: blocks of one width each, with the colour of each block, ``[block, 3]`` uint8 RGB.
    """
    centers = np.concatenate([cells.centers for cells, _ in parts])
    middle = (centers.min(axis=0) + centers.max(axis=0)) / 2
    corners, colors = [], []
    for cells, painted in parts:
        for face, (axis, side) in enumerate(FACES):
            open_faces = ~_covered(cells, axis, side)
            corners.append(_corners(cells[open_faces], axis, side) - middle)
            shade = np.minimum(painted[open_faces] * SHADES[face] / 255, 1.0)
            colors.append(np.repeat(_linear(shade), 4, axis=0))
    return _glb(np.concatenate(corners).astype(np.float32), np.concatenate(colors)), middle


def _covered(cells: DrawnCells, axis: int, side: int) -> Array:
    """Return for each block whether another one of the same width stands right before its face."""
    numbers = np.floor(cells.local / cells.size + 1e-6).astype(np.int64)
    numbers -= numbers.min(axis=0) - 1
    spans = tuple(int(span) + 2 for span in numbers.max(axis=0))
    own = np.ravel_multi_index(tuple(numbers.T), spans)
    numbers[:, axis] += side
    covered: Array = np.isin(np.ravel_multi_index(tuple(numbers.T), spans), own)
    return covered


def _corners(cells: DrawnCells, axis: int, side: int) -> Array:
    """Return the four corners of a face of each block, ``[block · 4, 3]`` world metres, counter-clockwise outside."""
    first, second = ((1, 2), (2, 0), (0, 1))[axis]
    offsets = np.zeros((4, 3))
    offsets[:, axis] = side
    offsets[:, first] = (-1, 1, 1, -1)
    offsets[:, second] = (-side, -side, side, side)
    around = (offsets * 0.5 * np.array(cells.size)) @ cells.axes
    corners: Array = (cells.centers[:, None] + around).reshape(-1, 3)
    return corners


def _linear(shade: Array) -> Array:
    """Return sRGB values 0…1 as linear ones of 16 bits with an opaque fourth channel, as glTF wants vertex colours."""
    linear = np.where(shade <= 0.04045, shade / 12.92, ((shade + 0.055) / 1.055) ** 2.4)
    return np.concatenate([np.rint(linear * 65535), np.full((len(shade), 1), 65535)], axis=1).astype(np.uint16)


def _glb(positions: Array, colors: Array) -> bytes:
    """Return a GLB file of quadrilaterals, four vertices each."""
    quads = np.arange(len(positions) // 4, dtype=np.uint32)[:, None] * 4
    indices = (quads + np.array([0, 1, 2, 0, 2, 3], np.uint32)).reshape(-1)
    buffers = [positions.tobytes(), colors.tobytes(), indices.tobytes()]
    views, offset = [], 0
    for buffer, target in zip(buffers, (34962, 34962, 34963), strict=True):
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(buffer), "target": target})
        offset += len(buffer)
    ends = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()} if len(positions) else {}
    accessors = [
        {"bufferView": 0, "componentType": FLOAT, "count": len(positions), "type": "VEC3", **ends},
        {"bufferView": 1, "componentType": UNSIGNED_SHORT, "normalized": True, "count": len(colors), "type": "VEC4"},
        {"bufferView": 2, "componentType": UNSIGNED_INT, "count": len(indices), "type": "SCALAR"},
    ]
    mesh = {"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}]}
    document = {
        "asset": {"version": "2.0"}, "extensionsUsed": [UNLIT], "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}], "meshes": [mesh], "materials": [{"extensions": {UNLIT: {}}}],
        "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": offset}],
    }  # fmt: skip
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(buffers)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
