"""Triangle meshes of OBJ files as arrays, standing on the ground with their middle at the origin.

MiniWorld's own reader needs eight seconds for its meshes, nearly all of it to turn their images around in
Python; this one needs a tenth.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class MeshPart:
    """Triangles of one material.

    Args:
        vertices: ``[vertex, 3]`` float32 in the file's own units, three vertices a triangle.
        normals: ``[vertex, 3]`` float32.
        tiles: ``[vertex, 2]`` float32 texture coordinates.
        colour: red, green, blue in 0 to 1.
        image: texture file; ``None`` for plain colour.
    """

    vertices: Array
    normals: Array
    tiles: Array
    colour: tuple[float, float, float]
    image: Path | None


@dataclass(frozen=True)
class Mesh:
    """A mesh in parts of one material each.

    Args:
        parts: triangles by material.
        height: height in the file's units.
        radius: radius of the circle around it on the ground, in the file's units.
    """

    parts: tuple[MeshPart, ...]
    height: float
    radius: float


def read_mesh(path: Path) -> Mesh:
    """Read an OBJ file of triangles, with the materials in the MTL file beside it."""
    vectors: dict[str, list[list[float]]] = {"v": [], "vt": [], "vn": []}
    faces: dict[str, list[list[int]]] = {}
    material = ""
    for words in _lines(path):
        if words[0] in vectors:
            vectors[words[0]].append([float(word) for word in words[1:4]])
        elif words[0] == "usemtl":
            material = words[1]
        elif words[0] == "f":
            faces.setdefault(material, []).extend(_corner(word) for word in words[1:4])
    materials = _read_materials(path)
    positions = _centred(
        np.array(vectors["v"], dtype=np.float32), np.concatenate([np.array(f) for f in faces.values()])
    )
    arrays = positions, np.array([vector[:2] for vector in vectors["vt"]] or [[0.0, 0.0]]), np.array(vectors["vn"])
    parts = tuple(
        _part(arrays, np.array(corners), *materials.get(name, materials[""])) for name, corners in faces.items()
    )
    drawn = np.concatenate([part.vertices for part in parts])
    return Mesh(parts, float(drawn[:, 1].max()), float(np.hypot(drawn[:, 0], drawn[:, 2]).max()))


def _lines(path: Path) -> list[list[str]]:
    lines = (line.split() for line in path.read_text(encoding="utf-8", errors="replace").splitlines())
    return [words for words in lines if words and not words[0].startswith("#")]


def _corner(word: str) -> list[int]:
    """Indices from 0 of position, texture coordinate and normal; a word of two has no texture coordinate."""
    numbers = [int(number) - 1 for number in word.split("/") if number]
    return numbers if len(numbers) == 3 else [numbers[0], 0, numbers[1]]


def _centred(positions: Array, corners: Array) -> Array:
    used = positions[corners[:, 0]]
    low, high = used.min(axis=0), used.max(axis=0)
    return positions - np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2], dtype=np.float32)


def _part(
    arrays: tuple[Array, Array, Array], corners: Array, colour: tuple[float, float, float], image: Path | None
) -> MeshPart:
    vertices, tiles, normals = (array[corners[:, axis]].astype(np.float32) for axis, array in enumerate(arrays))
    return MeshPart(vertices, normals, tiles, colour, image)


def _read_materials(path: Path) -> dict[str, tuple[tuple[float, float, float], Path | None]]:
    """Colour and image of each material; ``""`` is the image of the mesh's own name."""
    own = path.with_suffix(".png")
    materials = {"": ((1.0, 1.0, 1.0), own if own.is_file() else None)}
    library = path.with_suffix(".mtl")
    name = ""
    for words in _lines(library) if library.is_file() else []:
        if words[0] == "newmtl":
            name = words[1]
            materials[name] = ((1.0, 1.0, 1.0), None)
        elif words[0] == "Kd":
            red, green, blue = (float(word) for word in words[1:4])
            materials[name] = ((red, green, blue), materials[name][1])
        elif words[0] == "map_Kd":
            materials[name] = (materials[name][0], path.parent / words[-1])
    return materials
