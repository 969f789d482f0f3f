"""The resolution of a memory: the edge of the smallest thing that it can tell apart."""

from __future__ import annotations

from typing import Any

import pytest

from tests.support.room_views import empty_memory, room_walk

PIXEL = 2.5 / room_walk(1).cameras.intrinsics[0, 0, 0].item()  # metres across at 2.5 m


@pytest.mark.parametrize(
    ("name", "settings", "metres"),
    [
        ("voxel", {"cell": [0.5, 0.5, 0.5]}, 0.5),
        ("voxel", {"cell": [0.02, 0.02, 0.02]}, 8 * PIXEL),  # patches of 8 pixels are larger than such a cell
        ("map2d", {"cell": [1, 1]}, 1.0),
        ("snapshots", {"grid": [6, 8]}, 8 * PIXEL),
        ("snapshots", {"grid": [3, 4]}, 16 * PIXEL),
        ("none", {}, None),
    ],
)
def test_a_memory_tells_its_resolution_two_and_a_half_metres_away(
    name: str, settings: dict[str, Any], metres: float | None
) -> None:
    measured = empty_memory(name, **settings).resolution(room_walk(1).cameras)
    assert measured == (metres if metres is None else pytest.approx(metres))


def test_what_is_farther_away_is_coarser() -> None:
    memory, cameras = empty_memory("snapshots"), room_walk(1).cameras
    assert memory.resolution(cameras, 5.0) == pytest.approx(2 * memory.resolution(cameras, 2.5))
