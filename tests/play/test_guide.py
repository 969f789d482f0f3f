"""The planner finds where a picture was taken, knowing the picture alone."""

from __future__ import annotations

import itertools
import math

import pytest

from persist_cli.api.policy import Goal
from persist_cli.errors import PersistError
from persist_cli.play.guide import Guide
from persist_cli.play.play import Play
from persist_cli.play.settings import GroundPose, Shown
from persist_cli.policies.shortest_path import wrapped
from tests.play.test_collisions import FORWARD, LEFT, play_in_room
from tests.support.pixel_cost import PixelCost
from tests.support.room_worlds import room_views, room_world
from tests.support.rooms import UP, look
from tests.support.scene_worlds import unseen_world


def guided(play: Play, monkeypatch: pytest.MonkeyPatch) -> list[Shown]:
    """Let the planner walk until it stays, and return what is shown."""
    monkeypatch.setattr("persist_cli.play.play.make_cost", lambda name, settings: PixelCost(settings))
    play.plan()
    shown = []
    while play.planning:
        shown.append(play.advance(frozenset()))
    assert shown[-1] is None
    return [one for one in shown if one is not None]


def metres(one: GroundPose, two: GroundPose) -> float:
    return math.dist((one.x, one.y), (two.x, two.y))


def test_the_planner_goes_to_where_the_picture_was_taken():
    picture = room_views(look((1.6, 1.25, -0.6), 60.0, 0.0))
    world = room_world(look((1.7, 1.25, 1.2), 0.0, 0.0))
    guide = Guide(Goal(picture.rgb[0], None, "room"), PixelCost(None), seed=0)
    while (actions := guide.decide(world)) != ():
        if actions is not None:
            world.step([list(actions)])
    goal, here = (
        GroundPose.of(pose, UP)
        for pose in (picture.cameras.world_from_camera[0], world.agents[0].now.cameras.world_from_camera[0])
    )
    assert metres(goal, here) < 0.9  # from 1.8 m
    assert abs(goal.degrees - here.degrees) < 30


def test_a_held_key_stops_the_planner(monkeypatch):
    play = play_in_room(look((1.7, 1.25, 0.5), 0.0, 0.0))
    play.take_goal()
    for held in (FORWARD, LEFT, LEFT):
        play.advance(held)
    monkeypatch.setattr("persist_cli.play.play.make_cost", lambda name, settings: PixelCost(settings))
    play.plan()
    assert play.planning
    assert play.advance(LEFT).action == "left"
    assert not play.planning
    assert play.advance(frozenset()) is None


def test_a_goal_that_is_taken_while_the_planner_walks_stops_it(monkeypatch):
    monkeypatch.setattr("persist_cli.play.play.make_cost", lambda name, settings: PixelCost(settings))
    monkeypatch.setattr(Guide, "decide", lambda *_: ("left",) * 3)
    play = play_in_room(look((1.7, 1.25, 0.5), 0.0, 0.0))
    play.take_goal()
    play.plan()
    assert play.advance(frozenset()).action == "left"
    play.take_goal()
    assert not play.planning
    assert play.advance(frozenset()) is None  # not the rest of the way to the old one


def test_a_walk_to_the_goal_is_shown_step_by_step_and_ends_nearer_to_it(monkeypatch):
    play = play_in_room(look((1.6, 1.25, -0.6), 60.0, 0.0))
    play.take_goal()
    goal = play.shown.pose
    for name, times in {"right": 4, "backward": 7}.items():
        shown = [play.advance({name}) for _ in range(times)][-1:]
    shown += guided(play, monkeypatch)
    for one, two in itertools.pairwise(shown):
        assert two.number == one.number + 1
        assert metres(one.pose, two.pose) < 0.26
        assert abs(wrapped(two.pose.degrees - one.pose.degrees)) < 16
    assert metres(goal, shown[-1].pose) < metres(goal, shown[0].pose) / 2
    assert play.advance(frozenset()) is None


def test_a_decision_is_made_in_parts_between_which_others_walk(monkeypatch):
    monkeypatch.setattr("persist_cli.play.play.make_cost", lambda name, settings: PixelCost(settings))
    play = play_in_room(look((1.7, 1.25, 0.5), 0.0, 0.0))
    play.take_goal()
    play.plan()
    assert [play.advance(frozenset()) for _ in range(6)] == [None] * 6  # 24 views and 12, six at once
    assert play.planning
    assert play.advance(frozenset()).action is not None


def test_a_key_after_a_blocked_step_of_the_planner_is_newly_held(monkeypatch):
    monkeypatch.setattr("persist_cli.play.play.make_cost", lambda name, settings: PixelCost(settings))
    monkeypatch.setattr(Guide, "decide", lambda *_: ("forward",))
    play = play_in_room(look((1.7, 1.25, -1.6), 0.0, 0.0))  # before the wall
    play.take_goal()
    assert play.advance(FORWARD) is not None
    play.plan()
    assert not play.advance(frozenset()).free
    assert play.advance(FORWARD) is not None


def test_a_way_that_is_longer_than_a_clip_is_walked_to_its_end(monkeypatch):
    ways = [("left",) * 10, ()]
    monkeypatch.setattr(Guide, "decide", lambda *_: ways.pop(0))
    play = play_in_room(look((1.7, 1.25, 0.5), 0.0, 0.0))
    play.take_goal()
    assert [one.action for one in guided(play, monkeypatch)] == ["left"] * 10


def test_a_plan_without_a_goal_is_refused():
    play = play_in_room(look((1.7, 1.25, 0.5), 0.0, 0.0))
    with pytest.raises(PersistError, match="there is no goal picture yet"):
        play.plan()


def test_a_planner_in_a_scene_compares_places_of_one_house_and_leaves_the_scene_as_it_was():
    world, scene = unseen_world(size=32)
    before, model = scene.cells, scene.model()
    model.windows = 0
    guide = Guide(Goal(world.agents[0].now.rgb[0], None, "room"), PixelCost(None), 0)
    assert [guide.decide(world) for _ in range(2)] == [None, None]  # two parts of a decision, six places each
    assert scene.cells is before
    assert 0 < model.windows < 6
