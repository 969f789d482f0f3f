"""What the walker knows to be in the way stops it, and it stands on free ground only."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from persist_cli.api.observations import Trajectory
from persist_cli.errors import PersistError
from persist_cli.play.play import Play
from persist_cli.play.settings import PlaySettings
from persist_cli.rollout.surroundings import Surroundings
from persist_cli.rollout.world_model import Agent
from tests.support.micro_model import FRAMEWISE, micro
from tests.support.room_worlds import BODY, RoomWorld, room_info, room_views
from tests.support.rooms import look

FORWARD, LEFT = frozenset({"forward"}), frozenset({"left"})


class ShortClips(RoomWorld):
    """The room in clips of any number of frames."""

    def __init__(self, agents: list[Agent]) -> None:
        super().__init__(agents)
        self.backbone = micro(**FRAMEWISE)


def play_in_room(pose: np.ndarray, kind: type[RoomWorld] = RoomWorld, **settings: Any) -> Play:
    """A walk in the ray-traced room."""
    start = Trajectory("room", room_views(pose), (None,), room_info())
    return Play({"none": kind([Agent(None, body=BODY)])}, start, PlaySettings(**settings))


def test_a_wall_is_shown_as_blocked_once_until_a_key_is_pressed_anew():
    play = play_in_room(look((1.7, 1.25, 0.0), 0.0, 0.0))  # along -z, 2 m from the wall
    shown = [play.advance(FORWARD) for _ in range(12)]
    assert [one.free for one in shown if one is not None] == [True] * 7 + [False]
    assert shown[-1] is None
    assert play.advance(FORWARD, pressed=FORWARD).free is False  # let go and pressed again between two frames
    assert play.advance(LEFT).free
    assert play.advance(FORWARD).pose == play.shown.pose


@pytest.mark.parametrize("frames", [None, 2, 4])
def test_a_step_and_a_turn_take_turns_at_a_wall_too_however_long_the_clips_are(frames):
    play = play_in_room(look((1.7, 1.25, -1.6), 0.0, 0.0), ShortClips, clip_frames=frames)  # before the wall
    shown = [play.advance(FORWARD | LEFT) for _ in range(8)]
    assert [one.action for one in shown] == ["forward", "left"] * 4
    assert not shown[0].free
    assert all(one.free for one in shown[1::2])


def test_a_wall_that_only_the_shown_frames_show_stops_the_walker():
    play = play_in_room(look((1.5, 1.25, -1.4), -90.0, 0.0))  # along +x, with the wall out of view to the left
    for _ in range(6):
        play.advance(LEFT)
    shown = [play.advance(FORWARD) for _ in range(4)]
    assert [one.free for one in shown if one is not None] == [True, False]


def test_a_jump_goes_to_free_ground_only():
    play = play_in_room(look((1.7, 1.25, 0.0), 0.0, 0.0))
    here = play.shown.pose
    assert play.jump(here.x, here.y + 0.5).free
    with pytest.raises(PersistError, match="something is in the way there"):
        play.jump(here.x, here.y + 1.95)
    with pytest.raises(PersistError, match="nothing is known of the ground there"):
        play.jump(here.x + 50, here.y)


def test_a_turn_is_never_in_the_way_of_anything(monkeypatch):
    play = play_in_room(look((1.7, 1.25, 0.0), 0.0, 0.0))
    monkeypatch.setattr(Surroundings, "blocks", lambda *_: True)  # by what the clip itself shows
    assert [play.advance(LEFT).free for _ in range(3)] == [True] * 3
    assert [play.advance(FORWARD).free for _ in range(2)] == [True, False]
