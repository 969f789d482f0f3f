"""Houses are repeatable, differ from each other, and can be walked through everywhere."""

from __future__ import annotations

import math

import numpy as np
import pytest

from persist_cli.simulators.building import build_house
from persist_cli.simulators.furnishing import MESHES, MeshKind
from persist_cli.simulators.houses import House, Rectangle, Thing, is_clear
from persist_cli.simulators.meshes import read_mesh
from persist_cli.simulators.panels import house_panels
from persist_cli.simulators.rendering import assets

SEEDS = range(60)
RADIUS = 0.2


@pytest.fixture(scope="module")
def houses() -> list[House]:
    return [build_house(seed) for seed in SEEDS]


def free_cells(house: House, spacing: float = 0.1) -> set[tuple[int, int]]:
    (low_x, low_z), (high_x, high_z) = house.bounds
    areas, things = house.walkable(RADIUS), house.things
    cells = set()
    for i in range(math.ceil((high_x - low_x) / spacing)):
        for j in range(math.ceil((high_z - low_z) / spacing)):
            ground = low_x + i * spacing, low_z + j * spacing
            if any(area.contains(ground) for area in areas) and is_clear(ground, RADIUS, things):
                cells.add((i, j))
    return cells


def largest_piece(cells: set[tuple[int, int]]) -> int:
    """Number of cells in the largest connected piece."""
    left, largest = set(cells), 0
    while left:
        piece, queue = 0, [left.pop()]
        while queue:
            i, j = queue.pop()
            piece += 1
            for neighbour in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
                if neighbour in left:
                    left.remove(neighbour)
                    queue.append(neighbour)
        largest = max(largest, piece)
    return largest


def test_equal_seeds_give_equal_houses() -> None:
    assert build_house(7) == build_house(7)


def test_every_seed_gives_another_house(houses: list[House]) -> None:
    looks = {tuple((room.ground, room.walls, room.things) for room in house.rooms) for house in houses}
    assert len(looks) == len(houses)


def test_houses_have_every_number_of_rooms_from_one_to_six(houses: list[House]) -> None:
    assert {len(house.rooms) for house in houses} == {1, 2, 3, 4, 5, 6}


def test_every_room_holds_three_things_or_more(houses: list[House]) -> None:
    assert min(len(room.things) for house in houses for room in house.rooms) >= 3


def test_rooms_do_not_overlap(houses: list[House]) -> None:
    for house in houses:
        grounds = [room.ground for room in house.rooms]
        assert not any(a.overlaps(b) for index, a in enumerate(grounds) for b in grounds[:index])


def test_an_agent_can_walk_to_nearly_all_free_ground(houses: list[House]) -> None:
    for house in houses[:8]:
        cells = free_cells(house)
        assert largest_piece(cells) > 0.99 * len(cells)  # a nook behind a cabinet may be cut off


def test_doors_join_all_rooms(houses: list[House]) -> None:
    for house in houses:
        joined = {0}
        for _ in house.rooms:
            joined |= {room for door in house.doors if joined & set(door.rooms) for room in door.rooms}
        assert joined == set(range(len(house.rooms)))


def test_some_houses_have_loops(houses: list[House]) -> None:
    assert sum(len(house.doors) >= len(house.rooms) for house in houses) >= 3


def test_the_four_walls_of_a_room_have_different_paint(houses: list[House]) -> None:
    assert all(len(set(room.walls)) == 4 for house in houses for room in house.rooms)


def test_most_rooms_have_pictures_on_their_walls(houses: list[House]) -> None:
    rooms = [room for house in houses for room in house.rooms]
    assert sum(len(room.pictures) >= 2 for room in rooms) > 0.9 * len(rooms)


def test_things_stand_inside_their_room(houses: list[House]) -> None:
    for room in (room for house in houses for room in house.rooms):
        assert all(room.ground.contains(thing.ground) for thing in room.things)


def test_the_distance_to_a_turned_box_is_measured_to_its_side() -> None:
    box = Thing("box", (1.0, 2.0), math.pi / 2, (2.0, 1.0, 0.4))
    assert box.distance((1.0, 2.9)) == pytest.approx(0.0)
    assert box.distance((1.5, 2.0)) == pytest.approx(0.3)
    assert box.distance((1.0, 3.5)) == pytest.approx(0.5)


def test_panels_of_a_box_face_outwards() -> None:
    box = Thing("box", (1.0, 2.0), 0.7, (0.6, 0.8, 0.4))
    house = build_house(0)
    panels = list(house_panels(house, [box]))[len(list(house_panels(house, []))) :]
    middle = np.array([1.0, 0.4, 2.0])
    assert len(panels) == 6
    assert all((panel.corners.mean(axis=0) - middle) @ panel.normal > 0 for panel in panels)


def test_walls_are_numbered_left_to_right_as_seen_from_inside() -> None:
    room = Rectangle(0.0, 0.0, 4.0, 3.0)
    assert room.wall(0) == ((0.0, 0.0), (4.0, 0.0))
    assert room.wall(1) == ((4.0, 0.0), (4.0, 3.0))


@pytest.mark.parametrize("kind", MESHES, ids=lambda kind: kind.name)
def test_meshes_stand_on_the_ground_within_their_circle(kind: MeshKind) -> None:
    mesh = read_mesh(assets() / "meshes" / f"{kind.name}.obj")
    lowest = min(float(part.vertices[:, 1].min()) for part in mesh.parts)
    assert lowest == pytest.approx(0.0, abs=1e-3 * mesh.height)
    assert kind.aspect - 0.02 < mesh.radius / mesh.height <= kind.aspect
