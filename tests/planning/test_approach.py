"""An agent that recognised its goal compares straight ways ahead, and goes to the best place on them."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from persist_cli.api.actions import ActionVocabulary, walking_actions
from persist_cli.api.cameras import Cameras
from persist_cli.api.cost import Cost, Futures
from persist_cli.api.ground import GroundMap
from persist_cli.api.policy import Goal
from persist_cli.planning.approach import SIDES, best_approach, glances, straight_ways, ways_aside
from persist_cli.planning.futures import WorldFutures
from persist_cli.planning.judge import Judge
from persist_cli.plugins import make_cost


class ElsewhereCost(Cost):
    """Costs 1 everywhere but at the last of some cameras."""

    reads = "place"

    def __init__(self, cameras: Cameras) -> None:
        super().__init__(None)
        self.pose = cameras.world_from_camera[-1]

    def measure(self, futures: Futures, goal: Goal, ground: GroundMap) -> Float[Tensor, "candidate frame"]:
        apart = (futures.world_from_camera - self.pose).abs().amax(dim=(-2, -1))
        return (apart > 1e-3).to(torch.float64)


def test_straight_ways_lead_ahead_and_to_both_sides() -> None:
    ways = straight_ways(walking_actions(0.25, 15.0), 4)
    assert ways[0] == ("forward",) * 4
    assert ("right", "right", "forward", "forward") in ways
    assert (len(ways), {len(way) for way in ways}) == (1 + 2 * SIDES, {4})


def test_the_best_place_is_reached_in_the_middle_of_a_way(model) -> None:
    agent = model.agents[0]
    place = agent.cameras_after(("left", "forward", "forward")).centers[-1]
    goal, ground = Goal(None, place, agent.info.scene), GroundMap.empty(agent.info.world_up)
    judge = Judge(WorldFutures(model, ground), make_cost("distance", {}), goal, ground, "best")
    assert best_approach(judge, agent.info.vocabulary, 6) == ("left", "forward", "forward")


def test_glances_turn_to_each_side_and_back() -> None:
    both = walking_actions(0.25, 15.0)
    one = ActionVocabulary(tuple(action for action in both.actions if action.name != "right"))
    assert glances(both) == [("left", "right"), ("right", "left")]
    assert glances(one) == [()]


def test_ways_aside_turn_back_beyond_the_first_heading() -> None:
    ways = ways_aside(walking_actions(0.25, 15.0))
    assert ("left",) * 2 + ("forward",) * 4 + ("right",) * 4 in ways
    assert ("right",) * 4 + ("forward",) * 2 + ("left",) * 6 in ways
    assert len(set(ways)) == 8


def test_without_a_turn_to_both_sides_there_is_no_way_aside() -> None:
    both = walking_actions(0.25, 15.0)
    one = ActionVocabulary(tuple(action for action in both.actions if action.name != "right"))
    assert ways_aside(one) == []
    assert straight_ways(one, 4)


def test_a_view_beside_the_straight_ways_is_reached_by_a_way_aside(model) -> None:
    agent = model.agents[0]
    wanted = ways_aside(agent.info.vocabulary)[-1][:-1]
    goal, ground = Goal(None, None, agent.info.scene), GroundMap.empty(agent.info.world_up)
    judge = Judge(WorldFutures(model, ground), ElsewhereCost(agent.cameras_after(wanted)), goal, ground, "best")
    assert best_approach(judge, agent.info.vocabulary, 6) == wanted


def test_an_agent_at_the_best_place_stays(model) -> None:
    agent = model.agents[0]
    goal, ground = Goal(None, agent.now.cameras.centers[0], agent.info.scene), GroundMap.empty(agent.info.world_up)
    judge = Judge(WorldFutures(model, ground), make_cost("distance", {}), goal, ground, "best")
    assert best_approach(judge, agent.info.vocabulary, 6) == ()
