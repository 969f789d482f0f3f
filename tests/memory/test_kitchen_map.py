"""The map of a real place: 7-Scenes Kinect frames, noisy depth, tracked poses."""

import torch

from persist_cli.api.geometry import in_view, unproject
from persist_cli.api.observations import Observations
from persist_memory.grid.pooling import Sampling, keys_of, pixel_cells
from tests.support.room_views import empty, kitchen, same_bits, written

AGREE = 0.05  # metres along the ray: the same surface, not one behind the other


def cells_of_one_surface(frame: Observations, other: Observations, **settings) -> tuple[torch.Tensor, torch.Tensor]:
    """For every fourth pixel of ``frame`` whose surface ``other`` sees too: its cell as either frame places it."""
    lattice = empty("voxel", **settings).lattice
    here, there = (pixel_cells(part, lattice, Sampling())[0] for part in (frame, other))
    points = unproject(frame.depth, frame.cameras)[0, ::4, ::4][frame.depth[0, ::4, ::4] > 0]
    visible, pixels, depth = in_view(points, other.cameras[0])
    column, row = pixels[visible].floor().long().unbind(-1)
    measured = other.depth[0, row, column].double()
    same = (measured > 0) & ((measured - depth[visible]).abs() < AGREE)
    cells = here[::4, ::4][frame.depth[0, ::4, ::4] > 0]
    return keys_of(cells[visible][same]), keys_of(there[row, column][same])


def share_in_same_cell(gap: int, **settings) -> float:
    pairs = [kitchen([first, first + gap]) for first in range(0, 110 - gap, 20)]
    cells = [cells_of_one_surface(pair[:1], pair[1:], **settings) for pair in pairs]
    one, other = (torch.cat(part) for part in zip(*cells, strict=True))
    assert len(one) > 10_000
    return float((one == other).double().mean())


def test_a_surface_seen_from_two_frames_fifty_apart_falls_into_the_same_cell_in_90_percent():
    assert share_in_same_cell(gap=10) >= 0.90


def test_with_cells_of_ten_centimetres_it_is_75_percent():
    assert share_in_same_cell(gap=10, cell=(0.1, 0.1, 0.1)) >= 0.75


def test_a_map_of_one_frame_has_99_percent_of_what_a_later_frame_sees_of_the_same_surface():
    earlier, later = kitchen([20]), kitchen([30])
    cells, _ = cells_of_one_surface(later, earlier)
    written_cells = written("voxel", earlier).grid.keys
    assert torch.isin(cells, written_cells).double().mean() > 0.99


def test_a_map_of_real_frames_knows_neither_order_nor_repetition():
    frames = kitchen([0, 40, 80])
    memory = empty("voxel")
    for number in (2, 0, 1, 2):
        memory.write(frames[number : number + 1])
    assert same_bits(memory, written("voxel", frames))
