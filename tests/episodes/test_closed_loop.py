"""Agents in the true house: where they stop, and what they take the goal for."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from persist_cli.api.geometry import near_poses
from persist_cli.api.ground import Cover
from persist_cli.episodes.episodes import Episode, EpisodeSet
from persist_cli.episodes.navigator import Navigator, PlanSettings, RowParts, make_planner, retrieved
from persist_cli.episodes.rows import PlanningRow
from persist_cli.episodes.run_episode import LoopSettings, run_closed_loop
from persist_cli.episodes.stop_rules import StopByCost, view_costs
from persist_cli.episodes.true_scene import TrueScene
from persist_cli.planning.judge import NEAR, TURNED
from persist_cli.planning.planners import CemSettings
from persist_cli.plugins import make_policy
from persist_cli.simulators.miniworld import MiniWorld
from tests.support.pixel_cost import PixelCost

RANKED = PlanningRow(
    name="rank-2, simulator", planner="rank", policy="random", memory="simulator", goal="image", walk=False,
    candidates=2,
)  # fmt: skip
STRAIGHT = PlanningRow(name="straight", planner="policy", policy="straight", memory=None, goal="place", walk=False)
ALONE = PlanningRow(name="policy", planner="policy", policy="random", memory=None, goal="image", walk=False)
COST = PixelCost(None)


@pytest.fixture
def scene(small_world: MiniWorld, found: list[Episode]) -> TrueScene:
    """An episode whose goal is in sight from the start."""
    return TrueScene(small_world, next(episode for episode in found if episode.in_sight))


def different_views(poses: Float[Tensor, "pose 4 4"]) -> int:
    """Count poses that are none of the ones before them again."""
    kept = poses[:1]
    for pose in poses[1:]:
        if not near_poses(pose[None], kept, NEAR, TURNED).any():
            kept = torch.cat([kept, pose[None]])
    return len(kept)


def recognise_at_once(scene: TrueScene, row: PlanningRow, settings: PlanSettings) -> dict[str, Any]:
    """Run an agent that takes any view for one of the goal."""
    scene.back_to_start()
    navigator = Navigator(row, RowParts(make_policy("random", {}), COST), settings, scene, 8)
    return run_closed_loop(scene, navigator, StopByCost(COST, math.inf), LoopSettings())


def test_an_agent_that_imagines_goes_to_the_best_view_before_it_stops(scene: TrueScene) -> None:
    before = view_costs(COST, scene.look(), scene.goal)[0]
    record = recognise_at_once(scene, RANKED, PlanSettings())
    assert (record["ended"], record["actions"] != "") == ("stopped", True)
    assert view_costs(COST, scene.look(), scene.goal)[0] < before


def test_an_approach_compares_all_its_ways_whatever_a_decision_may_imagine(scene: TrueScene) -> None:
    whole, bounded = (recognise_at_once(scene, RANKED, PlanSettings(frames=frames)) for frames in (None, 16))
    assert bounded["actions"] == whole["actions"] != ""


def test_an_approach_is_compared_with_no_older_one(scene: TrueScene) -> None:
    scene.back_to_start()
    navigator = Navigator(RANKED, RowParts(make_policy("random", {}), COST), PlanSettings(), scene, 8)
    way = navigator.approach().actions
    assert way
    assert navigator.approach().actions == ()  # the view is no better than before
    navigator.decide()  # the goal was not recognised meanwhile
    assert navigator.approach().actions == way


def test_an_agent_that_explores_does_not_plan_to_look_again_from_where_it_has_looked(scene: TrueScene) -> None:
    views = []
    for explore in (False, True):
        scene.back_to_start()
        row, parts = replace(RANKED, candidates=8), RowParts(make_policy("random", {}), COST)
        navigator = Navigator(row, parts, PlanSettings(explore=explore), scene, 8)
        run_closed_loop(scene, navigator, StopByCost(COST, -math.inf), LoopSettings(execute=8, patience=8))
        views.append(different_views(torch.cat(navigator.looked)))
    assert views[1] > views[0]


def test_what_an_agent_writes_down_after_its_actions_is_timed_apart(scene: TrueScene) -> None:
    scene.back_to_start()
    navigator = Navigator(ALONE, RowParts(make_policy("random", {})), PlanSettings(), scene, 8)
    assert navigator.writing == 0
    frames, _ = scene.follow(("left", "right"))
    navigator.saw(frames[1:], 2)
    assert navigator.writing > 0


@pytest.mark.parametrize(("row", "approach"), [(RANKED, False), (ALONE, True)])
def test_an_agent_that_does_not_approach_stops_at_once(scene: TrueScene, row: PlanningRow, approach: bool) -> None:
    record = recognise_at_once(scene, row, PlanSettings(approach=approach))
    assert (record["ended"], record["actions"], record["figures"]["decisions"]) == ("stopped", "", 0)


def test_the_goals_place_is_that_of_the_given_frame_most_like_its_image(scene: TrueScene) -> None:
    found = retrieved(scene.goal, scene.walk(), COST)
    assert found.rgb is None
    torch.testing.assert_close(found.position, scene.goal.position)  # the walk begins at the goal


def test_an_agent_that_hit_something_knows_it(episodes: EpisodeSet, small_world: MiniWorld) -> None:
    scene = TrueScene(small_world, episodes.episodes[0])
    scene.back_to_start()
    row, parts = STRAIGHT, RowParts(make_policy("straight", {}))
    navigator = Navigator(row, parts, PlanSettings(), scene, 8)
    navigator.collided(scene.look(), "left")
    occupied = [int((navigator.ground.map().states == Cover.OCCUPIED).sum())]
    navigator.collided(scene.look(), "forward")
    occupied.append(int((navigator.ground.map().states == Cover.OCCUPIED).sum()))
    assert occupied[1] > occupied[0]


def test_a_row_of_cem_plans_with_what_was_set_and_keeps_nothing_where_that_is_said() -> None:
    row = PlanningRow(
        name="cem, simulator", planner="cem", policy=None, memory="simulator", goal="place", walk=True, candidates=7
    )
    plans = PlanSettings().of_cem(["method.kept=0.3", "method.smoothing=0"], rounds=2)
    wanted = CemSettings(horizon=5, candidates=7, rounds=2, kept=0.3, smoothing=0.0, shift=0.5)
    assert make_planner(row, None, plans, 5).settings == wanted
    assert make_planner(row, None, replace(plans, keep=False), 5).settings == replace(wanted, shift=0.0)


class StopsAt:
    """The rule of an agent that recognises its goal in views of some numbers, counted from 0."""

    def __init__(self, *numbers: int) -> None:
        self.numbers, self.seen = numbers, -1

    def stops(self, view: object, goal: object, world_up: object) -> bool:
        """Return whether the next view is one of them."""
        self.seen += 1
        return self.seen in self.numbers


class Proposes(type(make_policy("random", {}))):  # type: ignore[misc]
    """A policy that always proposes the same."""

    way: tuple[str, ...] = ()

    def propose(self, situation: object, horizon: int, count: int, generator: object) -> list[tuple[str, ...]]:
        """Return it as often as asked for."""
        return [self.way[:horizon]] * count


def run_alone(scene: TrueScene, rule: StopsAt, way: tuple[str, ...], **settings: int) -> dict[str, Any]:
    """Run an agent that always proposes a way, and follows it without imagining."""
    scene.back_to_start()
    policy = Proposes(make_policy("random", {}).settings)
    policy.way = way
    navigator = Navigator(ALONE, RowParts(policy, COST), PlanSettings(), scene, 8)
    return run_closed_loop(scene, navigator, rule, LoopSettings(**settings))


def test_who_proposes_nothing_has_stopped_by_himself(scene: TrueScene) -> None:
    record = run_alone(scene, StopsAt(), ())
    assert (record["ended"], record["actions"]) == ("gave no action", "")
    assert (record["figures"]["wrong_stop"], record["figures"]["actions"]) == (1, 0)


def test_a_goal_that_is_recognised_after_the_last_action_is_a_stop_and_one_never_seen_is_none(scene: TrueScene) -> None:
    way = ("left", "right", "left", "left")
    last = run_alone(scene, StopsAt(3), way, max_actions=3)
    assert (last["ended"], last["actions"]) == ("stopped", "left right left")
    out = run_alone(scene, StopsAt(), way, max_actions=3)
    assert (out["ended"], out["figures"]["wrong_stop"], out["figures"]["actions"]) == ("out of actions", 0, 3)


def test_an_agent_stops_at_the_first_view_of_its_goal_and_not_at_the_end_of_its_plan(scene: TrueScene) -> None:
    record = run_alone(scene, StopsAt(2), ("left",) * 8, execute=8)
    assert (record["ended"], record["actions"], record["figures"]["decisions"]) == ("stopped", "left*2", 1)


def test_the_metres_left_are_measured_anew_after_every_action(scene: TrueScene) -> None:
    way = scene.info.vocabulary.parse(scene.episode.actions)
    record = run_alone(scene, StopsAt(len(way)), way, execute=len(way))
    assert record["figures"]["end_metres"] == pytest.approx(0, abs=1e-6)
    assert record["figures"]["start_metres"] > 1
    assert (record["figures"]["success"], record["figures"]["spl"]) == (1, pytest.approx(1))
    assert record["refused"] == []
