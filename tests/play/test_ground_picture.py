"""The map of a walk shows each square in the colour of its highest observed point, at its place."""

from __future__ import annotations

import numpy as np
import torch

from persist_cli.api.ground import Cover, GroundMap, ground_axes
from persist_cli.api.memory import MapPoints
from persist_cli.api.observations import Origin
from persist_cli.play.ground_picture import Marks, backdrop_of_ground, backdrop_of_points, draw_ground
from persist_cli.play.settings import GroundPose
from tests.play.test_collisions import play_in_room
from tests.support.rooms import look

UP = (0.0, 0.0, 1.0)
RED, GREEN, BLUE = (255, 0, 0), (0, 255, 0), (0, 0, 255)
FAR = GroundPose(-3.0, -3.0, 0.0)


def points(*rows):
    """Points of 0.25 m: position, colour and origin of each."""
    positions, colors, origins = zip(*rows, strict=True)
    return MapPoints(
        torch.tensor(positions, dtype=torch.float64), torch.tensor(colors, dtype=torch.uint8), 0.25,
        torch.tensor(origins, dtype=torch.uint8),
    )  # fmt: skip


def color_at(picture, x, y):
    """The colour at a place in metres."""
    left, bottom, right, top = picture.extent
    height, width = picture.picture.shape[:2]
    row, column = int((top - y) / (top - bottom) * height), int((x - left) / (right - left) * width)
    return tuple(picture.picture[row, column].tolist())


def drawn(memory):
    backdrop = backdrop_of_points(memory, ground_axes(UP), camera_height=1.25)
    return draw_ground(backdrop, Marks(FAR, FAR, []), 256)


def test_the_highest_point_under_the_ceiling_is_seen_at_its_place():
    seen, low, high = (1.0, 2.0, 0.5), (1.0, 2.0, 0.0), (1.0, 2.0, 2.5)
    picture = drawn(points((low, RED, 2), (seen, GREEN, 2), (high, BLUE, 2), ((2.0, 0.0, 0.0), RED, 2)))
    assert color_at(picture, 1.0, 2.0) == GREEN
    assert color_at(picture, 2.0, 0.0) == RED
    assert color_at(picture, 0.0, 1.0) not in (RED, GREEN, BLUE)


def test_what_is_observed_is_drawn_over_what_is_imagined_which_is_pale():
    both = ((0.0, 0.0, 1.0), RED, Origin.IMAGINED), ((0.0, 0.0, 0.0), BLUE, Origin.OBSERVED)
    picture = drawn(points(*both, ((1.0, 0.0, 0.0), RED, Origin.IMAGINED)))
    assert color_at(picture, 0.0, 0.0) == BLUE
    assert min(color_at(picture, 1.0, 0.0)) > 80


def test_a_memory_without_points_shows_the_ground():
    states = torch.full((4, 4), int(Cover.UNKNOWN), dtype=torch.uint8)
    ground = GroundMap(states, (0.0, 0.0), 0.5, ground_axes(UP))
    assert backdrop_of_ground(ground) is None
    states[0, 1], states[3, 3] = int(Cover.FREE), int(Cover.OCCUPIED)
    picture = draw_ground(backdrop_of_ground(ground), Marks(FAR, FAR, []), 256)
    assert color_at(picture, 0.75, 0.25) == (255, 255, 255)
    assert color_at(picture, 1.75, 1.75) == (90, 90, 90)


def test_the_picture_shows_the_way_and_reaches_to_the_agent():
    picture = draw_ground(None, Marks(GroundPose(4.0, 0.0, 90.0), FAR, [[(-3.0, -3.0), (4.0, 0.0)]]), 200)
    left, bottom, right, top = picture.extent
    assert left < -3 and right > 4 and bottom < -3 and top > 0  # noqa: PT018
    assert max(picture.picture.shape) == 200
    assert len(np.unique(picture.picture.reshape(-1, 3).numpy(), axis=0)) > 2


def test_the_way_is_a_line_that_a_jump_breaks_and_a_reset_forgets():
    play = play_in_room(look((1.7, 1.25, 0.0), 0.0, 0.0), ahead=False)
    for _ in range(2):
        play.advance({"forward"})
    here = play.shown.pose
    play.jump(here.x, here.y - 0.25)
    play.advance({"forward"})
    assert [len(part) for part in play._surveyor._parts()] == [3, 2]
    play.reset()
    assert [len(part) for part in play._surveyor._parts()] == [1]


def test_the_picture_reaches_over_all_of_the_way_and_shows_points_that_are_all_high_up():
    far = draw_ground(None, Marks(FAR, FAR, [[(-3.0, -3.0), (6.0, -3.0), (-3.0, -3.0)]]), 200)
    assert far.extent[2] > 6
    assert color_at(drawn(points(((1.0, 2.0, 9.0), GREEN, 2))), 1.0, 2.0) == GREEN
