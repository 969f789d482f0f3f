"""The map of a real place: 7-Scenes Kinect frames, noisy depth, tracked poses."""

import torch

from persist_cli.api.geometry import in_view, unproject
from persist_cli.api.observations import Observations
from persist_memory.grid.pooling import GridSettings, cell_numbers
from persist_memory.grid.storage import keys_of_numbers
from tests.support.room_views import empty_memory, kitchen_frames, same_bits, written_memory

SAME_SURFACE = 0.05  # metres along the ray: the same surface, not one behind the other


def cells_of_one_surface(frame: Observations, other: Observations, **settings) -> tuple[torch.Tensor, torch.Tensor]:
    """Keys of the cells into which ``frame`` and ``other`` put a surface, for every fourth pixel that both see."""
    lattice = empty_memory("voxel", **settings).lattice
    here, there = (cell_numbers(part, lattice, GridSettings())[0] for part in (frame, other))
    points = unproject(frame.depth, frame.cameras)[0, ::4, ::4][frame.depth[0, ::4, ::4] > 0]
    visible, pixels, depth = in_view(points, other.cameras[0])
    column, row = pixels[visible].floor().long().unbind(-1)
    measured = other.depth[0, row, column].double()
    same = (measured > 0) & ((measured - depth[visible]).abs() < SAME_SURFACE)
    numbers = here[::4, ::4][frame.depth[0, ::4, ::4] > 0]
    return keys_of_numbers(numbers[visible][same]), keys_of_numbers(there[row, column][same])


def share_in_same_cell(gap: int, **settings) -> float:
    pairs = [kitchen_frames([first, first + gap]) for first in range(0, 110 - gap, 20)]
    cells = [cells_of_one_surface(pair[:1], pair[1:], **settings) for pair in pairs]
    first, second = (torch.cat(part) for part in zip(*cells, strict=True))
    assert len(first) > 10_000
    return float((first == second).double().mean())


def test_of_a_surface_seen_from_two_frames_90_percent_fall_into_the_same_cell():
    assert share_in_same_cell(gap=10) >= 0.90


def test_of_a_surface_seen_from_two_frames_75_percent_fall_into_the_same_cell_of_ten_centimetres():
    assert share_in_same_cell(gap=10, cell=(0.1, 0.1, 0.1)) >= 0.75


def test_a_map_of_one_frame_has_99_percent_of_the_cells_of_a_surface_that_a_later_frame_sees_too():
    earlier, later = kitchen_frames([20]), kitchen_frames([30])
    cells, _ = cells_of_one_surface(later, earlier)
    written_cells = written_memory("voxel", earlier).grid.keys
    assert torch.isin(cells, written_cells).double().mean() > 0.99


def test_a_map_of_real_frames_depends_neither_on_their_order_nor_on_repetition():
    frames = kitchen_frames([0, 40, 80])
    memory = empty_memory("voxel")
    for number in (2, 0, 1, 2):
        memory.write(frames[number : number + 1])
    assert same_bits(memory, written_memory("voxel", frames))
