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
