"""The cells of a house agree with what its frames show, and follow what the agent does."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from persist_cli.api.cameras import Cameras
from persist_cli.api.cells import FREE, OUTSIDE, CellGrid
from persist_cli.api.geometry import unproject
from persist_cli.simulators.building import build_house
from persist_cli.simulators.house_cells import CEILING, DOOR, FLOOR, FORM, TOP, WALL, structure_cells
from persist_cli.simulators.houses import House, Thing
from persist_cli.simulators.miniworld import MiniWorld
from persist_cli.simulators.policies import POLICIES, walk

HOUSE = 3


@pytest.fixture(scope="module")
def structure() -> CellGrid:
    return structure_cells(build_house(HOUSE))


def class_at(grid: CellGrid, x: float, y: float, z: float) -> int:
    """The class of the cell at a place in world metres."""
    numbers = grid.numbers(torch.tensor([x, y, z])) - torch.tensor(grid.corner)
    return int(grid.classes[tuple(numbers.tolist())])


def stand_before(world: MiniWorld, shape: str) -> Thing:
    """Put the agent a metre before a movable thing of a shape in the open house, looking at it."""
    things = [thing for thing in world.house.things if thing.movable and thing.shape == shape and not thing.elevation]
    for thing in things:
        for angle in np.linspace(-math.pi, math.pi, 24):
            (x, z), distance = world.ahead(float(angle)), 1.0 + thing.radius
            ground = thing.ground[0] - distance * x, thing.ground[1] - distance * z
            if world.is_free(ground):
                world.place(ground, float(angle))
                return thing
    pytest.fail(f"house {world.house.seed} has no {shape} that can be reached")


def test_every_cell_of_a_house_is_known(structure: CellGrid) -> None:
    assert structure.known.all()


def test_the_floor_is_the_lowest_level_and_the_ceiling_the_highest(structure: CellGrid) -> None:
    assert (structure.classes == FLOOR).any(dim=0).any(dim=0).nonzero().tolist() == [[0]]
    assert (structure.classes == CEILING).any(dim=0).any(dim=0).nonzero().tolist() == [[TOP]]


def test_a_wall_is_one_cell_thick(structure: CellGrid) -> None:
    room = build_house(HOUSE).rooms[0].ground
    classes = [class_at(structure, room.high_x + offset, 2.5, room.low_z + 0.2) for offset in (-0.15, 0.1)]
    assert classes == [FREE, WALL]


def test_a_doorway_is_free_and_a_door_is_above_it(structure: CellGrid) -> None:
    for door in build_house(HOUSE).doors:
        x, z = door.passage.center
        heights = [0.0, 0.25, door.height - 0.25, door.height + 0.25]
        assert [class_at(structure, x, height, z) for height in heights] == [FLOOR, FREE, FREE, DOOR]


def test_one_can_walk_through_every_doorway() -> None:
    """At least three cells beside each other are free up to the height of an agent."""
    for house in map(build_house, range(4)):
        grid = structure_cells(house)
        for door in house.doors:
            area = door.passage
            inside = [area.contains((x, z)) for x, _, z in grid.centers()[:, :, 0].reshape(-1, 3).tolist()]
            columns = grid.classes.reshape(-1, grid.shape[2])[torch.tensor(inside)]
            assert len(columns) >= 3
            assert (columns[:, 1:6] == FREE).all()


def house_without_a_ceiling() -> House:
    houses = map(build_house, range(100))
    return next(house for house in houses if any(room.ceiling is None for room in house.rooms))


def test_a_missing_ceiling_is_outside_and_the_room_below_it_free() -> None:
    house = house_without_a_ceiling()
    x, z = next(room for room in house.rooms if room.ceiling is None).ground.center
    grid = structure_cells(house)
    assert [class_at(grid, x, height, z) for height in (2.75, 2.5)] == [OUTSIDE, FREE]


def test_what_no_room_contains_is_outside(structure: CellGrid) -> None:
    rooms = [room.ground.grown(0.1, 0.1) for room in build_house(HOUSE).rooms]
    centers = structure.centers()[:, :, 4, :].reshape(-1, 3)
    inside = torch.tensor([any(room.contains((x, z)) for room in rooms) for x, _, z in centers.tolist()])
    assert torch.equal(structure.classes[:, :, 4].reshape(-1) == OUTSIDE, ~inside)


def test_the_box_of_a_house_stays_when_a_thing_is_carried(world: MiniWorld) -> None:
    before = world.cells()
    stand_before(world, "box")
    assert world.act("pick_up")
    assert (world.cells().corner, world.cells().shape) == (before.corner, before.shape)


def test_a_thing_leaves_its_cells_when_it_is_picked_up_and_is_in_others_when_it_is_dropped(world: MiniWorld) -> None:
    thing, box = stand_before(world, "box"), FORM.palette.index("box")
    x, z = thing.ground
    assert class_at(world.cells(), x, 0.25, z) == box
    assert world.act("pick_up")
    carried = world.cells()
    assert class_at(carried, x, 0.25, z) == FREE
    world.act("left")
    assert world.cells() is carried
    assert world.act("drop")
    dropped = world.cells()
    assert int((dropped.classes == box).sum()) > int((carried.classes == box).sum())


def test_a_toggled_box_changes_colour_and_nothing_else(world: MiniWorld) -> None:
    before, _ = world.cells(), stand_before(world, "box")
    assert world.act("toggle")
    after = world.cells()
    changed = (after.colors != before.colors).any(dim=-1)
    assert torch.equal(after.classes, before.classes)
    assert changed.any()
    assert set(after.classes[changed].tolist()) == {FORM.palette.index("box")}


def test_every_thing_has_a_cell_however_small_it_is(world: MiniWorld) -> None:
    grid = world.cells()
    for thing in world.house.things:
        near = (grid.centers()[..., [0, 2]] - torch.tensor(thing.ground)).norm(dim=-1) < thing.radius + 0.25
        assert (grid.classes[near] == FORM.palette.index(thing.shape)).any()


def test_cells_agree_with_what_frames_show(world: MiniWorld) -> None:
    """Rays pass through free cells and end in solid ones, whose colours are those of the pixels."""
    frames = list(walk(world, POLICIES["explore"], np.random.default_rng(0), 12))
    depth = torch.from_numpy(np.stack([frame.depth for frame in frames])).double()
    poses = torch.from_numpy(np.stack([frame.world_from_camera for frame in frames]))
    intrinsics = torch.from_numpy(world.info.intrinsics).expand(len(frames), 3, 3)
    ends, grid = unproject(depth, Cameras(poses, intrinsics, 64, 64)), world.cells()
    ways = ends - poses[:, None, None, :3, 3]
    unit = ways / ways.norm(dim=-1, keepdim=True)
    corner = torch.tensor(grid.corner)
    last = grid.numbers(ends + 0.03 * unit) - corner  # pictures stand 4 cm off their walls
    solid = grid.solid[last.unbind(-1)]
    colors = torch.from_numpy(np.stack([frame.rgb for frame in frames])).int()
    errors = (grid.colors[last.unbind(-1)].int() - colors).abs().float().mean(dim=-1)[solid]
    passed = torch.cat([(ends - back * unit)[ways.norm(dim=-1) > back] for back in (0.15, 0.3, 0.6, 1.2)])
    seen = set(map(tuple, (grid.numbers(passed) - corner).tolist())) - set(map(tuple, last.reshape(-1, 3).tolist()))
    solid_cells = grid.solid
    free = [not solid_cells[cell] for cell in seen]
    assert solid.float().mean() > 0.97
    assert np.mean(free) > 0.97
    assert errors.median() < 12  # of 255; a cell has one colour, textures have many
