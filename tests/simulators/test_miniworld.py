"""MiniWorld's images are repeatable, its depth is exact, and its agent moves by the nominal motion."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from persist_cli.api.cameras import Cameras
from persist_cli.api.geometry import camera_rays, project, unproject
from persist_cli.api.observations import Frame
from persist_cli.errors import DataError, RecipeError
from persist_cli.plugins import make_simulator
from persist_cli.simulators.building import build_house
from persist_cli.simulators.houses import Thing
from persist_cli.simulators.miniworld import MiniWorld, MiniWorldSettings
from persist_cli.simulators.rendering import Renderer
from tests.support.miniworlds import fingerprint, make_world, print_errors_without, print_fingerprint, put_somewhere
from tests.support.processes import ForkedProcess

LIBRARIES = "libegl1 libgl1 libglu1-mesa libgl1-mesa-dri"


def printed(file: Path, function: Callable[..., None], *arguments: object, **environment: str) -> str:
    """What a function prints in a process of its own."""
    process = ForkedProcess(function, *arguments, environment=environment, output=file)
    assert process.wait() == 0, file.read_text()
    return file.read_text().strip()


def camera(world: MiniWorld, frame: Frame) -> Cameras:
    intrinsics, pose = torch.from_numpy(world.info.intrinsics), torch.from_numpy(frame.world_from_camera)
    return Cameras(pose[None], intrinsics[None], world.info.height, world.info.width)


def depth_at(depth: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
    """Depth between pixels; 1/z is linear on a flat surface."""
    grid = pixels / torch.tensor([depth.shape[1], depth.shape[0]]) * 2 - 1
    inverse = (1 / depth.double().clamp_min(1e-3))[None, None]
    sampled = torch.nn.functional.grid_sample(inverse, grid[None, None].double(), align_corners=False)
    return 1 / sampled[0, 0, 0]


def test_another_process_gives_equal_pixels_for_a_house(world: MiniWorld, tmp_path: Path) -> None:
    frame, ((x, z), _) = world.observe(), world.agent
    assert printed(tmp_path / "printed", print_fingerprint, x, z) == fingerprint(frame)


def test_another_house_gives_different_pixels(world: MiniWorld) -> None:
    before = world.observe().rgb
    world.open_scene(4)
    put_somewhere(world)
    assert np.abs(world.observe().rgb.astype(int) - before).mean() > 5


def test_the_depth_of_the_floor_is_exact_to_a_tenth_of_a_millimetre(world: MiniWorld) -> None:
    frame = world.observe()
    points = unproject(torch.from_numpy(frame.depth)[None], camera(world, frame))[0]
    floor = points[-12:, :, 1][points[-12:, :, 1] < 0.1]
    assert floor.numel() > 100
    assert float(floor.abs().median()) < 1e-4


def test_the_depth_of_a_far_wall_is_exact_to_a_millimetre(world: MiniWorld) -> None:
    room = max((room.ground for room in world.house.rooms), key=lambda ground: ground.width)
    eye, forward = (room.low_x + 0.1, 2.6, room.center[1]), (1.0, 0.0, 0.0)
    renderer = Renderer(64, 64)
    renderer.load(world.house, world.house.things)
    _, depth = renderer.render(eye, forward, 30.0)
    assert depth[30:34, 28:36] == pytest.approx(room.high_x - eye[0], abs=1e-3)


def test_two_views_agree_within_a_millimetre(world: MiniWorld) -> None:
    errors = []
    for seed in range(4):
        put_somewhere(world, seed)
        first = world.observe()
        assert world.act("left")
        second = world.observe()
        points = unproject(torch.from_numpy(first.depth)[None], camera(world, first)).reshape(1, -1, 3)
        pixels, depth = (value[0] for value in project(points, camera(world, second)))
        inside = ((pixels > 1) & (pixels < 63)).all(-1) & (depth > 0)
        errors.append((depth_at(torch.from_numpy(second.depth), pixels[inside]) - depth[inside]).abs())
    assert float(torch.cat(errors).median()) < 1e-3  # 0.007 mm when this was written


def test_views_of_a_camera_that_looks_down_agree_within_a_millimetre(world: MiniWorld) -> None:
    low = world.with_settings(MiniWorldSettings(fov=50.0, camera_height=0.8, pitch=-20.0, turn=5.0))
    low.open_scene(3)
    put_somewhere(low)
    first = low.observe()
    assert low.act("left")
    second = low.observe()
    points = unproject(torch.from_numpy(first.depth)[None], camera(low, first)).reshape(1, -1, 3)
    pixels, depth = (value[0] for value in project(points, camera(low, second)))
    inside = ((pixels > 1) & (pixels < 63)).all(-1) & (depth > 0)
    assert float((depth_at(torch.from_numpy(second.depth), pixels[inside]) - depth[inside]).abs().median()) < 1e-3
    floor = points[0, -64:, 1]
    assert float(floor.abs().min()) < 1e-3


def test_the_heading_is_the_optical_axis_and_left_is_left(world: MiniWorld) -> None:
    pose = torch.from_numpy(world.observe().world_from_camera)
    x, z = world.ahead(world.agent[1])
    assert pose[:3, 2].tolist() == pytest.approx([x, 0.0, z])
    assert pose[:3, 1].tolist() == pytest.approx([0.0, -1.0, 0.0])
    assert float(torch.linalg.det(pose[:3, :3])) == pytest.approx(1.0)
    world.act("left")
    turned = torch.from_numpy(world.observe().world_from_camera)[:3, 2]
    assert float(turned @ pose[:3, 0]) == pytest.approx(-math.sin(math.radians(15)))


def test_the_field_of_view_is_that_of_the_intrinsics() -> None:
    world = make_world(height=40, width=80, fov=90.0)
    world.open_scene(3)
    put_somewhere(world)
    rays = camera_rays(camera(world, world.observe()))[0]
    assert float(rays[0, 0, 1]) == pytest.approx(-39 / 40)
    assert float(rays[0, -1, 0]) == pytest.approx(79 / 40)


def test_the_sky_has_no_depth(world: MiniWorld) -> None:
    houses = (build_house(seed) for seed in range(200))
    house, room = next((house, room) for house in houses for room in house.rooms if room.ceiling is None)
    renderer = Renderer(64, 64)
    renderer.load(house, [])
    (x, z), sky = room.ground.center, 25.0
    _, depth = renderer.render((x, 1.2, z), (0.01, 1.0, 0.0), sky)
    assert not depth.any()


def test_recorded_poses_are_the_nominal_motion(world: MiniWorld) -> None:
    random, info = np.random.default_rng(0), world.info
    poses, done = [world.observe().world_from_camera], []
    for _ in range(100):
        action = str(random.choice(["forward", "backward", "left", "right", "stay"]))
        if world.act(action):
            done.append(action)
            poses.append(world.observe().world_from_camera)
    recorded = torch.from_numpy(np.stack(poses))
    nominal = info.vocabulary.follow(recorded[0], done, torch.tensor(info.world_up, dtype=torch.float64))
    assert float((nominal - recorded[1:]).abs().max()) < 1e-6


def test_a_blocked_action_changes_nothing(world: MiniWorld) -> None:
    for _ in range(100):
        if not world.act("forward"):
            break
    before, agent = world.observe(), world.agent
    assert not world.act("forward")
    after = world.observe()
    assert agent == world.agent
    assert np.array_equal(before.rgb, after.rgb)
    assert np.array_equal(before.world_from_camera, after.world_from_camera)


def test_a_long_step_does_not_pass_through_walls() -> None:
    world = make_world(step=5.0)
    world.open_scene(3)
    put_somewhere(world)
    for _ in range(24):
        (x, z), heading = world.agent
        ahead_x, ahead_z = world.ahead(heading)
        way = [(x + share * ahead_x, z + share * ahead_z) for share in np.linspace(0.0, 5.0, 200)]
        moved = world.act("forward")
        assert moved <= all(world.is_free(ground) for ground in way[::40])
        world.place((x, z), heading)
        world.act("left")


def face_a_movable_thing(world: MiniWorld) -> None:
    for seed in range(50):
        world.open_scene(seed)
        for thing in (thing for thing in world.house.things if thing.movable and thing.elevation == 0):
            x, z = thing.ground[0] - thing.radius - 1.3, thing.ground[1]
            if thing.shape == "box" and world.is_free((x, z)):
                world.place((x, z), 0.0)
                if world.act("toggle") and world.act("toggle") and world.act("pick_up"):
                    world.open_scene(seed)
                    world.place((x, z), 0.0)
                    return
    pytest.fail("no house has a movable box with free ground before it")


def test_pick_up_and_drop_move_a_thing(world: MiniWorld) -> None:
    face_a_movable_thing(world)
    before = world.observe().rgb
    assert not world.act("drop")
    assert world.act("pick_up")
    carried = world.observe().rgb
    assert not world.act("pick_up")
    assert world.act("drop")
    assert not np.array_equal(before, carried)
    assert not np.array_equal(carried, world.observe().rgb)


def face_a_pile(world: MiniWorld) -> Thing:
    """Stand before a movable box with something on it, and return that."""
    for seed in range(50):
        world.open_scene(seed)
        for top in (thing for thing in world.house.things if thing.movable and thing.elevation > 0):
            boxes = [thing for thing in world.house.things if thing.ground == top.ground and thing.elevation == 0]
            x, z = top.ground[0] - 1.2, top.ground[1]
            if boxes and boxes[0].movable and world.is_free((x, z)):
                world.place((x, z), 0.0)
                if world.act("pick_up"):
                    return top
    pytest.fail("no house has a pile with free ground before it")


def test_what_stands_on_a_box_is_picked_up_before_the_box(world: MiniWorld) -> None:
    top = face_a_pile(world)
    left = [thing for thing in world._things if thing.ground == top.ground]
    assert [thing.elevation for thing in left] == [0]


def test_a_toggled_thing_has_the_complement_of_its_colour(world: MiniWorld) -> None:
    face_a_movable_thing(world)
    before = list(world._things)
    assert world.act("toggle")
    [(old, new)] = [(old, new) for old, new in zip(before, world._things, strict=True) if old != new]
    assert [a + b for a, b in zip(old.paint.tint, new.paint.tint, strict=True)] == pytest.approx([1, 1, 1])


def test_a_thing_behind_the_agent_or_far_ahead_is_out_of_reach(world: MiniWorld, monkeypatch) -> None:
    face_a_movable_thing(world)
    for _ in range(12):
        assert world.act("left")
    assert not world.act("toggle")
    monkeypatch.setattr(world, "_no_wall_before", lambda ground: True)
    thing = next(thing for thing in world._things if thing.shape == "box")
    ((x, z), heading), reach = world.agent, 1.5 + thing.radius
    ahead_x, ahead_z = world.ahead(heading)
    for metres, within in ((reach - 0.05, True), (reach + 0.05, False)):
        world._things = [replace(thing, movable=True, ground=(x + metres * ahead_x, z + metres * ahead_z))]
        assert world.act("toggle") == within


def alone_before_a_wall(world: MiniWorld) -> Thing:
    """Let the agent stand before a bare wall, all things away, and return a movable box that was there."""
    face_a_movable_thing(world)
    box = next(thing for thing in world._things if thing.shape == "box" and thing.movable)
    world._things = []
    while world.act("forward"):
        pass
    (x, z), heading = world.agent
    ahead_x, ahead_z = world.ahead(heading)
    rooms = world.house.walkable(0.0)
    assert not any(room.contains((x + 0.35 * ahead_x, z + 0.35 * ahead_z)) for room in rooms)
    return box


def test_nothing_is_reached_through_a_wall(world: MiniWorld) -> None:
    box = alone_before_a_wall(world)
    (x, z), heading = world.agent
    ahead_x, ahead_z = world.ahead(heading)
    world._things = [replace(box, ground=(x + 0.9 * ahead_x, z + 0.9 * ahead_z))]
    assert not world.act("toggle")
    assert not world.act("pick_up")


def test_a_carried_thing_stops_the_agent_where_it_touches_a_wall_or_another_thing(world: MiniWorld) -> None:
    box = alone_before_a_wall(world)
    wall = world.agent[0]
    for _ in range(6):
        assert world.act("backward")
    ((x, z), heading), start = world.agent, world.agent
    ahead_x, ahead_z = world.ahead(heading)
    world._carried, world._things = box, []
    while world.act("forward"):
        pass
    stopped = math.dist(world.agent[0], wall)
    assert box.radius + 0.3 + box.radius - 0.5 < stopped < box.radius + 0.3 + box.radius + 0.5
    world._ground = start[0]
    away = 0.2 + 2 * box.radius + 0.3 + 0.1  # the thing is carried at 0.2 + radius + 0.3
    world._things = [replace(box, ground=(x + away * ahead_x, z + away * ahead_z))]
    assert not world.act("forward")


def test_what_is_put_down_lies_on_the_floor_before_the_agent_and_a_move_to_elsewhere_loses_nothing(
    world: MiniWorld,
) -> None:
    face_a_movable_thing(world)
    things = len(world._things)
    assert world.act("pick_up")
    assert world.act("drop")
    down = world._things[-1]
    (x, z), heading = world.agent
    ahead_x, ahead_z = world.ahead(heading)
    assert (down.elevation, down.heading) == (0, heading)
    distance = 0.2 + down.radius + 0.3
    assert down.ground == pytest.approx((x + distance * ahead_x, z + distance * ahead_z))
    assert world.act("pick_up")
    world.place((x, z), heading)
    assert not world.act("drop")
    assert len(world._things) == things


def test_toggle_changes_a_thing_and_a_second_toggle_undoes_it(world: MiniWorld) -> None:
    face_a_movable_thing(world)
    before = world.observe().rgb
    assert world.act("toggle")
    toggled = world.observe().rgb
    assert world.act("toggle")
    assert not np.array_equal(before, toggled)
    assert np.array_equal(before, world.observe().rgb)


def test_a_place_inside_a_wall_is_refused(world: MiniWorld) -> None:
    with pytest.raises(DataError, match=r"house 3: \(-9\.00, -9\.00\) is not free"):
        world.place((-9.0, -9.0), 0.0)


def test_wrong_settings_are_refused_with_a_hint() -> None:
    with pytest.raises(RecipeError, match="did you mean 'fov'"):
        make_simulator("miniworld", {"fow": 75})
    with pytest.raises(RecipeError, match="fov 200"):
        make_simulator("miniworld", {"fov": 200.0})


def test_a_missing_driver_is_reported_with_the_packages_to_install(tmp_path: Path) -> None:
    line = printed(tmp_path / "printed", print_errors_without, [""], __EGL_VENDOR_LIBRARY_DIRS="/nonexistent")
    assert "EGL" in line
    assert LIBRARIES in line
    assert len(line.splitlines()) == 1


def test_a_missing_library_or_package_is_reported_with_how_to_install_it(tmp_path: Path) -> None:
    missing = ["miniworld", "pyglet.libs.egl"]
    package, library = printed(tmp_path / "printed", print_errors_without, missing).splitlines()
    assert "pip install 'persist-cli[miniworld]'" in package
    assert LIBRARIES in library
