"""An agent that recognised its goal compares straight ways ahead, and goes to the best place on them."""

from __future__ import annotations

from persist_cli.api.actions import walking_actions
from persist_cli.api.ground import GroundMap
from persist_cli.api.policy import Goal
from persist_cli.planning.approach import SIDES, best_approach, straight_ways
from persist_cli.planning.futures import WorldFutures
from persist_cli.planning.judge import Judge
from persist_cli.plugins import make_cost


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


def test_an_agent_at_the_best_place_stays(model) -> None:
    agent = model.agents[0]
    goal, ground = Goal(None, agent.now.cameras.centers[0], agent.info.scene), GroundMap.empty(agent.info.world_up)
    judge = Judge(WorldFutures(model, ground), make_cost("distance", {}), goal, ground, "best")
    assert best_approach(judge, agent.info.vocabulary, 6) == ()
