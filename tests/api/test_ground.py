"""The ground that an agent walks on, and the cells on it that an interaction reaches."""

import pytest
import torch

from persist_cli.api.ground import Cover, GroundMap, ground_axes
from persist_cli.api.reach import cells_in_reach
from tests.support.cell_rooms import camera_at, cell_room

UPS = [(0.0, 1.0, 0.0), (0.0, -2.0, 0.0), (0.0, 0.0, 1.0), (0.3, 0.8, -0.1)]


@pytest.mark.parametrize("up", UPS)
def test_ground_axes_are_a_rotation_whose_last_row_is_up(up):
    axes = ground_axes(up)
    assert torch.allclose(axes @ axes.T, torch.eye(3, dtype=torch.float64), atol=1e-12)
    assert float(torch.linalg.det(axes)) == pytest.approx(1.0)
    assert axes[2].tolist() == pytest.approx(torch.nn.functional.normalize(torch.tensor(up).double(), dim=0).tolist())


@pytest.mark.parametrize("up", UPS)
def test_places_on_the_ground_do_not_change_with_the_height(up):
    ground, position = GroundMap.empty(up), torch.tensor([0.7, -1.2, 2.5], dtype=torch.float64)
    higher = position + 3 * ground.axes[2]
    assert ground.places(higher).tolist() == pytest.approx(ground.places(position).tolist())


def test_known_places_are_the_middles_of_the_squares_that_are_known():
    states = torch.zeros(3, 7, dtype=torch.uint8)
    states[2, 5], states[0, 1], states[1, 6] = int(Cover.FREE), int(Cover.OCCUPIED), int(Cover.FREE)
    ground = GroundMap(states, (-0.4, 2.0), 0.1, ground_axes(UPS[0]))
    places = ground.known_places()
    assert sorted(places.flatten().tolist()) == pytest.approx(sorted([0.15, 2.25, -0.25, 2.05, 0.25, 2.15]))
    assert sorted(ground.at(places).tolist()) == [Cover.FREE, Cover.FREE, Cover.OCCUPIED]


def test_outside_of_a_map_nothing_is_known():
    ground = GroundMap(torch.full((3, 7), int(Cover.FREE), dtype=torch.uint8), (0.0, 0.0), 0.1, ground_axes(UPS[0]))
    inside = torch.tensor([[0.01, 0.01], [0.69, 0.29]], dtype=torch.float64)
    beside = torch.tensor([[-0.01, 0.1], [0.1, -0.01], [0.71, 0.1], [0.1, 0.31]], dtype=torch.float64)
    assert ground.at(inside).tolist() == [Cover.FREE] * 2
    assert ground.at(beside).tolist() == [Cover.UNKNOWN] * 4


def test_an_interaction_reaches_the_cells_ahead_within_two_metres_and_a_quarter_at_all_heights():
    grid = cell_room()
    pose = camera_at(grid, (3, 4, 5), (12, 4, 2)).world_from_camera[0]
    reached = cells_in_reach(grid, pose)
    assert torch.equal(reached, reached[..., :1].expand(grid.shape))
    cells = {"ahead": (11, 4), "aside": (4, 10), "too far": (13, 4), "too far aside": (10, 11), "behind": (2, 4)}
    assert {name: bool(reached[cell][0]) for name, cell in cells.items()} == {
        "ahead": True, "aside": True, "too far": False, "too far aside": False, "behind": False,
    }  # fmt: skip
