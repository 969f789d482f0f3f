"""What is shown of a plan, where the truth is what the model imagines."""

import pytest

from persist_cli.api.ground import GroundMap
from persist_cli.api.policy import Goal
from persist_cli.planning.futures import WorldFutures
from persist_cli.planning.judge import Judge
from persist_cli.planning.outputs import Planned, chosen_video, look_at, round_json
from persist_cli.planning.planners import finished
from persist_cli.plugins import make_cost


def planned(model, over, *rounds):
    """Return some rounds of candidates as a plan whose goal is two steps ahead."""
    agent, cost = model.agents[0], make_cost("distance", {})
    place, ground = agent.cameras_after(("forward",) * 2).centers[-1], GroundMap.empty(agent.info.world_up)
    goal, futures = Goal(None, place, agent.info.scene), WorldFutures(model, ground)
    judge = Judge(futures, cost, goal, ground, over)
    for number, candidates in enumerate(rounds, 1):
        judge.judge([names.split() for names in candidates], number)
    return Planned(finished(judge, len(rounds)), goal, cost, ground, futures)


@pytest.mark.parametrize("over", ["best", "last"])
def test_the_true_cost_is_that_of_the_frame_that_counts(model, monkeypatch, over):
    plan = planned(model, over, ["forward forward forward", "left", "left forward forward forward"])
    monkeypatch.setattr("persist_cli.planning.outputs.true_futures", lambda now, info: (plan.futures, ""))
    shown = look_at(plan, 3)
    assert shown.true_costs == pytest.approx([candidate.cost for candidate in plan.ranked()])
    assert [len(video) for video in shown.imagined] == [len(one.actions) for one in plan.ranked()]
    count = shown.candidates[0].best
    assert len(chosen_video(model.agents[0].now.rgb, plan.goal, shown)) == count + 1


def test_a_round_is_told_with_its_own_mean_and_the_least_cost_so_far(model):
    plan = planned(model, "last", ["forward forward", "left"], ["right"]).plan
    first, second = (round_json(plan, number) for number in (1, 2))
    assert (first["new_candidates"], second["new_candidates"]) == (2, 1)
    assert [first["mean_cost"], second["mean_cost"]] == pytest.approx([0.2, 0.4], abs=1e-6)
    assert [first["least_cost"], second["least_cost"]] == pytest.approx([0.0, 0.0], abs=1e-6)
