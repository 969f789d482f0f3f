"""The map is seen from above, true to scale, and repeatable."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from persist_cli.api.cells import CellOrigin
from persist_cli.api.ground import ground_axes
from persist_cli.api.memory import MapPoints
from persist_cli.output.map import DrawnCandidate, draw_before_and_after, draw_candidates, draw_map, paint
from tests.support.room_views import room_walk, written_memory
from tests.support.rooms import UP

RED, GREEN, BLUE = (255, 0, 0), (0, 255, 0), (0, 0, 255)


def points(*colored_positions) -> MapPoints:
    positions, colors = zip(*colored_positions, strict=True)
    return MapPoints(torch.tensor(positions, dtype=torch.float64), torch.tensor(colors, dtype=torch.uint8), 0.5)


@pytest.mark.parametrize("up", [UP, (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.6, 0.0, -0.8)])
def test_the_map_is_seen_from_above_and_never_mirrored(up):
    axes = ground_axes(up)
    torch.testing.assert_close(axes @ axes.T, torch.eye(3, dtype=torch.float64))
    assert torch.linalg.det(axes) > 0.99  # right, up in the picture, towards the viewer: right-handed
    torch.testing.assert_close(axes[2], torch.tensor(up, dtype=torch.float64))


def test_the_highest_point_under_the_ceiling_is_drawn():
    tower = points(((0, 0.0, 0), RED), ((0, 1.0, 0), GREEN), ((0, 2.5, 0), BLUE))
    image, _ = paint(tower, ground_axes(UP), 1.5)
    assert {tuple(color) for color in image[image[..., 3] > 0][:, :3]} == {(0.0, 1.0, 0.0)}


def test_the_map_is_transparent_where_there_is_no_point():
    image, extent = paint(points(((0, 0, 0), RED), ((3, 0, 0), BLUE)), ground_axes(UP), None)
    assert np.isclose(extent[0], -0.25)
    assert (image[..., 3] == 0).mean() > 0.5
    assert image[1, 1, 0] == 1.0
    assert image[1, -3, 2] == 1.0


def test_small_cells_of_a_floor_seen_from_afar_are_drawn_without_gaps():
    cells = replace(points(*(((0.075 * number, 0, 0), RED) for number in range(5))), spread=0.02)
    image, _ = paint(cells, ground_axes(UP), None)
    [drawn] = {int(row.sum()) for row in image[..., 3] if row.any()}
    assert drawn in (image.shape[1], image.shape[1] - 1)  # all columns


def test_points_are_drawn_even_when_all_are_above_the_cameras():
    image, _ = paint(points(((0, 5.0, 0), RED)), ground_axes(UP), 1.0)
    assert (image[..., 3] > 0).any()


def test_what_is_imagined_is_pale_and_striped_and_never_hides_what_was_observed():
    floor, cloud = ((0, 0.0, 0), RED), ((0, 1.0, 0), BLUE)
    mixed = replace(points(floor, cloud, ((3, 0, 0), BLUE)), origins=torch.tensor([2, 1, 1], dtype=torch.uint8))
    image, _ = paint(mixed, ground_axes(UP), None)
    drawn = {tuple(color) for color in image[image[..., 3] > 0][:, :3].round(2)}
    assert drawn == {(1.0, 0.0, 0.0), (0.85, 0.85, 1.0), (0.45, 0.45, 1.0)}


def test_what_is_edited_keeps_its_colour_between_coloured_stripes():
    cells = points(((0, 0.0, 0), GREEN), ((3, 0, 0), BLUE))
    cells = replace(cells, origins=torch.tensor([CellOrigin.EDITED, CellOrigin.OBSERVED], dtype=torch.uint8))
    image, _ = paint(cells, ground_axes(UP), None)
    drawn = {tuple(color) for color in image[image[..., 3] > 0][:, :3].round(2)}
    assert drawn == {(0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.85, 0.11, 0.38)}


def test_two_maps_of_a_place_are_drawn_side_by_side_at_one_scale(tmp_path):
    before, after = points(((0, 0, 0), RED), ((3, 0, 0), BLUE)), points(((0, 0, 0), RED))
    draw_before_and_after(before, after, UP, {}, tmp_path / "pair.png")
    draw_map(before, UP, {}, tmp_path / "one.png")
    pair, one = Image.open(tmp_path / "pair.png"), Image.open(tmp_path / "one.png")
    assert pair.width == pytest.approx(2 * one.width, abs=2)
    assert pair.height == one.height


def test_a_map_without_imagined_points_looks_as_before_and_has_no_legend_for_them(tmp_path):
    walk = room_walk(4)
    memory = written_memory("voxel", walk)
    seen, dreamt = memory.points(), replace(memory.points(), origins=torch.ones(memory.figures().cells))
    for name, some in (("seen", seen), ("dreamt", dreamt)):
        draw_map(some, UP, {}, tmp_path / f"{name}.png")
    pictures = [np.asarray(Image.open(tmp_path / f"{name}.png").convert("RGB")) for name in ("seen", "dreamt")]
    assert pictures[0].shape == pictures[1].shape
    assert pictures[1].mean() > pictures[0].mean() + 5
    corners = [picture[: len(picture) // 8, -picture.shape[1] // 4 :] for picture in pictures]
    assert not np.array_equal(*corners)


def test_a_map_shows_several_paths_in_their_colours(tmp_path):
    observations = room_walk()
    poses = observations.cameras.world_from_camera
    memory = written_memory("voxel", observations)
    draw_map(memory.points(), UP, {"ground truth": poses, "rollout": poses[:3]}, tmp_path / "map.png")
    picture = np.asarray(Image.open(tmp_path / "map.png").convert("RGB")).astype(int)
    assert min(picture.shape[:2]) > 500
    for color in ((0xD8, 0x1B, 0x60), (0x1E, 0x88, 0xE5)):
        assert (np.abs(picture - color).sum(-1) < 12).sum() > 50


@pytest.mark.parametrize("paths", [{}, [], [torch.eye(4)], {"still": torch.eye(4).expand(1, 4, 4)}])
def test_an_empty_memory_and_a_short_path_still_give_a_picture(tmp_path, paths):
    nothing = MapPoints(torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, 3, dtype=torch.uint8))
    paths = [path[None] for path in paths] if isinstance(paths, list) else paths
    draw_map(nothing, UP, paths, tmp_path / "map.png")
    assert Image.open(tmp_path / "map.png").size[0] > 100


def test_drawing_a_map_twice_gives_equal_files(tmp_path):
    memory = written_memory("voxel", room_walk(2))
    for name in ("a.png", "b.png"):
        draw_map(memory.points(), UP, {}, tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def of_color(file, color):
    """Rows and columns ``[dot, 2]`` of the dots of a picture that have about this colour."""
    image = np.asarray(Image.open(file).convert("RGB")).astype(int)
    return np.argwhere(np.abs(image - np.array(color)).max(-1) < 12)


def near_color(file, color):
    """How many dots of a picture have about this colour."""
    return len(of_color(file, color))


def test_what_lies_further_right_or_up_on_the_ground_is_drawn_there_to_scale(tmp_path):
    draw_map(points(((-2, 0, 1), RED), ((2, 0, 0), BLUE)), UP, {}, tmp_path / "map.png")
    down, right = of_color(tmp_path / "map.png", BLUE).mean(0) - of_color(tmp_path / "map.png", RED).mean(0)
    metres_right, metres_up = (torch.tensor([4.0, 0, -1]).double() @ ground_axes(UP)[:2].T).tolist()
    assert right / metres_right > 0
    assert down == pytest.approx(-metres_up * right / metres_right, abs=3)


def test_an_arrow_at_the_end_of_a_path_points_where_the_camera_looks(tmp_path):
    nothing = MapPoints(torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, 3, dtype=torch.uint8))
    ends = []
    for sign in (-1, 1):
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, 2] = sign * ground_axes(UP)[0]
        draw_map(nothing, UP, [pose[None]], tmp_path / "map.png")
        ends.append(of_color(tmp_path / "map.png", (0xD8, 0x1B, 0x60))[:, 1].min())
    left, right = ends
    assert left < right


def test_places_where_a_camera_was_stopped_are_crossed(tmp_path):
    floor = points(((0, 0, 0), RED), ((3, 0, 0), RED))
    stop = torch.eye(4, dtype=torch.float64)[None]
    stop[0, 0, 3] = 1.5
    draw_map(floor, UP, {}, tmp_path / "free.png")
    draw_map(floor, UP, {}, tmp_path / "blocked.png", stop)
    assert near_color(tmp_path / "blocked.png", (0, 0, 0)) > near_color(tmp_path / "free.png", (0, 0, 0)) + 50


def test_candidates_are_drawn_in_colours_of_their_costs_under_the_chosen_one_and_the_goal(tmp_path):
    paths = torch.eye(4, dtype=torch.float64).repeat(3, 4, 1, 1)
    for path, axis, sign in zip(paths, (2, 0, 0), (1, 1, -1), strict=True):
        path[:, axis, 3] = sign * torch.arange(4) * 0.25
    candidates = [DrawnCandidate(path, cost) for path, cost in zip(paths, (0.1, 0.9, math.inf), strict=True)]
    goal, no_points = torch.tensor([0.0, 0.0, 1.0]), points(((0, 0, 0), RED))
    draw_candidates(no_points, UP, candidates, goal, tmp_path / "goal.png")
    draw_candidates(no_points, UP, candidates[:2], None, tmp_path / "none.png")
    magenta, yellow, grey, star = (216, 27, 96), (253, 231, 37), (158, 158, 158), (255, 179, 0)
    assert all(near_color(tmp_path / "goal.png", color) > 20 for color in (magenta, yellow, grey, star))
    assert near_color(tmp_path / "none.png", star) == 0
    assert near_color(tmp_path / "none.png", grey) < near_color(tmp_path / "goal.png", grey)
