"""Maps of any size are drawn with a bounded number of blocks that stand for all of them."""

import json
import struct
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from persist_cli.viewer.block_mesh import block_mesh
from persist_cli.viewer.drawn_cells import DrawnCells, painted
from persist_cli.viewer.level_of_detail import DetailTree


def solid_block(side: int) -> DrawnCells:
    """A cube of cells of 0.5 m with random colours; the first of them is edited."""
    numbers = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), -1).reshape(-1, 3)
    rng = np.random.default_rng(0)
    origins = np.full(len(numbers), 2, np.uint8)
    origins[0] = 3
    colors = rng.integers(0, 256, (len(numbers), 3)).astype(np.uint8)
    return DrawnCells(numbers * 0.5, colors, origins, np.zeros(len(numbers), np.uint8), (0.5, 0.5, 0.5), np.eye(3))


def volume(parts):
    return sum(len(part) * np.prod(part.size) for part in parts)


def test_a_map_that_is_small_enough_is_drawn_cell_by_cell():
    cells = solid_block(4)
    (part,) = DetailTree(cells).select(64)
    assert part.size == cells.size
    assert np.array_equal(np.sort(part.centers, axis=0), np.sort(cells.centers, axis=0))


def test_a_larger_map_is_drawn_with_wider_blocks_that_fill_the_same_space():
    (part,) = DetailTree(solid_block(8)).select(100)
    assert len(part) == 64
    assert part.size == (1.0, 1.0, 1.0)
    assert volume([part]) == 8**3 * 0.5**3


@pytest.mark.parametrize("most", [70, 200, 400])
def test_blocks_are_smallest_near_the_view_and_never_more_than_allowed(most):
    parts = DetailTree(solid_block(8)).select(most, np.zeros(3))
    nearest = [np.linalg.norm(part.centers, axis=1).min() for part in parts]
    assert sum(map(len, parts)) <= most
    assert [part.size for part in parts] == sorted(part.size for part in parts)
    assert nearest == sorted(nearest)
    assert volume(parts) == 8**3 * 0.5**3


def test_a_wide_block_has_the_mean_colour_of_its_cells_and_shows_that_one_was_edited():
    cells = solid_block(2)
    (part,) = DetailTree(cells).select(1)
    assert np.abs(part.colors[0] - cells.colors.mean(axis=0)).max() <= 0.5
    nearly_one = replace(cells, colors=np.minimum(np.arange(8), 1).astype(np.uint8)[:, None].repeat(3, axis=1))
    assert DetailTree(nearly_one).select(1)[0].colors.tolist() == [[1, 1, 1]]
    assert part.origins.tolist() == [3]
    assert painted(part, "origin").tolist() == [[216, 27, 96]]


def test_faces_between_blocks_are_not_in_the_mesh():
    cells = solid_block(3)
    mesh, middle = block_mesh([(cells, cells.colors)])
    length = struct.unpack_from("<I", mesh, 12)[0]
    document = json.loads(mesh[20 : 20 + length])
    assert document["accessors"][0]["count"] == 6 * 9 * 4
    assert document["accessors"][0]["max"] == pytest.approx([0.75] * 3)
    assert middle.tolist() == [0.5] * 3


def test_a_map_without_a_cell_has_no_blocks():
    assert [len(part) for part in DetailTree(solid_block(2)[:0]).select(10)] == [0]


def test_of_a_long_row_blocks_grow_step_by_step_away_from_the_view():
    numbers = np.arange(512)[:, None] * np.array([1, 0, 0])
    none = np.zeros(512, np.uint8)
    cells = DrawnCells(numbers * 0.5, np.zeros((512, 3), np.uint8), none, none, (0.5, 0.5, 0.5), np.eye(3))
    parts = DetailTree(cells).select(160, np.zeros(3))
    widths = [part.size[0] for part in parts]
    assert widths == [0.5 * 2**number for number in range(len(parts))]
    assert len(parts) >= 3
    farthest = [float(part.centers[:, 0].max() + part.size[0] / 2) for part in parts]
    assert [second / first for first, second in pairwise(farthest[:-1])] == pytest.approx([2.0] * (len(parts) - 2), 0.2)


def test_blocks_of_no_known_origin_are_grey():
    cells = replace(solid_block(1), origins=np.zeros(1, np.uint8))
    assert painted(cells, "origin").tolist() == [[128, 128, 128]]
