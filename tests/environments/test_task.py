"""Rewards, poses and goals of an episode, by cases that can be computed by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from persist_cli.api.policy import Goal
from persist_cli.environments.task import FARTHEST, Attempt, TaskSettings, View, moving_actions
from persist_cli.errors import DataError
from persist_cli.io.settings import parse_settings
from tests.support.rooms import UP, Room, look

BLACK = np.zeros((4, 4, 3), np.uint8)


def view(x: float, z: float, yaw: float, left: float, free: bool = True) -> View:
    """A view at a place and heading of the room, with some metres left to the goal."""
    return View(BLACK, np.zeros((4, 4), np.float32), look((x, 1.3, z), yaw, 0.0), left, free)


def attempt(**settings: object) -> Attempt:
    """An episode that begins at the origin, 3 m before its goal."""
    goal = Goal(torch.zeros(4, 4, 3, dtype=torch.uint8), torch.from_numpy(ahead(3.0)), "room")
    return Attempt(view(0, 0, 0, 3.0), goal, UP, TaskSettings(**settings))


def ahead(metres: float) -> np.ndarray:
    """The position so far ahead of the start."""
    start = look((0.0, 1.3, 0.0), 0.0, 0.0)
    return start[:3, 3] + metres * start[:3, 2]


def test_a_step_is_rewarded_by_the_metres_that_it_comes_nearer():
    episode = attempt()
    assert episode.advance([view(0, 0.25, 0, 2.75)]) == pytest.approx(0.25 - 0.01)
    assert not episode.reached


def test_a_blocked_action_costs_a_penalty_and_is_counted():
    episode = attempt()
    assert episode.advance([view(0, 0, 0, 3.0, free=False)]) == pytest.approx(-0.01 - 0.05)
    assert episode.info()["collisions"] == 1


def test_a_chunk_of_actions_ends_with_the_first_that_reaches_the_goal():
    episode = attempt(chunk=3)
    reward = episode.advance([view(0, 1.0, 0, 2.0), view(0, 2.0, 0, 1.0), view(0, 1.0, 0, 2.0)])
    assert episode.reached
    assert reward == pytest.approx(2.0 - 0.02 + 2.5)
    assert episode.info()["walked"] == pytest.approx(2.0)


def test_a_chunk_of_actions_is_one_step_of_the_episode():
    episode = attempt(chunk=3)
    episode.advance([view(0, 0, 15, 3.0), view(0, 0, 30, 3.0), view(0, 0.25, 30, 2.8)])
    assert episode.steps == 1


def test_rewards_of_an_episode_sum_to_the_way_that_was_made():
    episode = attempt(step_cost=0.0)
    lefts = (2.5, 2.8, 2.9, 1.7, 2.2)
    assert sum(episode.advance([view(0, 0, 0, left)]) for left in lefts) == pytest.approx(3.0 - 2.2)


def test_a_pose_says_metres_ahead_and_to_the_left_and_the_turn_to_the_left():
    episode = attempt()
    start = episode.now.world_from_camera
    left = np.cross(UP, start[:3, 2])
    there = look((0.0, 1.3, 0.0), 0.0, 0.0)
    there[:3, 2], there[:3, 0] = left, start[:3, 2]  # it looks to the left: what was ahead lies on its right
    there[:3, 3] += 2.0 * start[:3, 2] + 0.5 * left
    episode.advance([View(BLACK, np.zeros((4, 4), np.float32), there, 1.5)])
    assert episode.observation()["pose"] == pytest.approx([2.0, 0.5, 0.0, 1.0], abs=1e-6)


def test_a_goal_that_is_a_place_is_told_from_where_the_agent_is():
    episode = attempt(observe_goal="place")
    assert episode.observation()["goal"] == pytest.approx([3.0, 0.0], abs=1e-6)
    there = look((0.0, 1.3, 0.0), 0.0, 0.0)
    there[:3, 3] = ahead(4.0)
    episode.advance([View(BLACK, np.zeros((4, 4), np.float32), there, 1.0)])
    assert episode.observation()["goal"] == pytest.approx([-1.0, 0.0], abs=1e-6)


def test_depth_is_observed_up_to_its_farthest_and_lies_in_its_space():
    depth = np.array([[0.0, 3.0], [FARTHEST, 3 * FARTHEST]], np.float32)
    start = View(BLACK[:2, :2], depth, look((0.0, 1.3, 0.0), 0.0, 0.0), 3.0)
    goal = Goal(torch.zeros(2, 2, 3, dtype=torch.uint8), torch.zeros(3), "room")
    seen = Attempt(start, goal, UP, TaskSettings()).observation()
    assert seen["depth"].tolist() == [[0.0, 3.0], [FARTHEST, FARTHEST]]
    assert seen["depth"].dtype == np.float32


def test_the_first_distance_of_an_episode_is_that_of_its_start():
    episode = attempt()
    episode.advance([view(0, 0.5, 0, 2.5), view(0, 1.0, 0, 2.0)])
    assert (episode.info()["first_distance"], episode.info()["distance"]) == (3.0, 2.0)


def test_a_goal_without_an_image_is_not_shown_as_a_black_one():
    episode = Attempt(view(0, 0, 0, 3.0), Goal(None, torch.zeros(3), "room"), UP, TaskSettings())
    with pytest.raises(DataError, match="give observe_goal='place'"):
        episode.observation()


def test_settings_that_cannot_be_met_are_one_line():
    for wrong in ({"success_radius": 0.0}, {"goal_distance": [0.5, 3.0]}, {"chunk": 0}, {"observe_goal": "sound"}):
        with pytest.raises(Exception, match=f"env: .*{next(iter(wrong))}") as caught:
            parse_settings(TaskSettings, wrong, "env")
        assert "\n" not in str(caught.value)


def test_a_capture_has_no_moving_actions():
    with pytest.raises(DataError, match="no action moves the camera"):
        moving_actions(Room().info)
