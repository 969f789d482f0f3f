"""Planners on the poses that candidates lead to, where the best plan is known."""

import dataclasses
import itertools
from types import SimpleNamespace

import pytest
import torch

from persist_cli.api.cost import Cost
from persist_cli.api.ground import GroundMap
from persist_cli.api.policy import Goal, Situation
from persist_cli.errors import DataError, PersistError, RecipeError
from persist_cli.io.settings import parse_settings
from persist_cli.planning.futures import WorldFutures
from persist_cli.planning.judge import LAST, Budget, Judge, check_goal
from persist_cli.planning.planners import Cem, CemSettings, Rank, RankSettings, draw, frequencies
from persist_cli.plugins import make_cost, make_policy
from tests.support.pixel_cost import PixelCost

AHEAD = ("forward",) * 4


@pytest.fixture
def situation(model):
    """An agent whose goal is the place where four steps ahead lead."""
    agent = model.agents[0]
    place = agent.cameras_after(AHEAD).centers[-1]
    return Situation(agent.now, agent.info, Goal(None, place, agent.info.scene), GroundMap.empty(agent.info.world_up))


@pytest.fixture
def judge(model, situation):
    """Return a function that makes a judge of the straight distance to that place."""

    def make(**changes):
        futures = WorldFutures(model, situation.ground)
        return Judge(futures, make_cost("distance", {}), situation.goal, situation.ground, **changes)

    return make


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def test_a_judge_measures_the_last_frame_or_the_best(judge):
    too_far = [*AHEAD, "forward", "forward"]
    last, best = judge().judge([too_far], 1)[0], judge(over="best").judge([too_far], 1)[0]
    assert (last.cost, last.best, last.chosen) == (pytest.approx(0.4), 6, tuple(too_far))
    assert (best.cost, best.best, best.chosen) == (pytest.approx(0.0, abs=1e-6), 4, AHEAD)
    stay = judge(over="best").judge([[], ["left"]], 1)[0]
    assert (stay.best, stay.chosen, stay.cost) == (0, (), pytest.approx(0.8))


def test_what_was_judged_is_not_imagined_again(judge):
    one = judge()
    first = one.judge([["left"], ["right"], ["left"]], 1)
    assert [candidate.actions for candidate in first] == [("left",), ("right",)]
    assert one.actions == 2
    assert one.judge([["left"]], 2)[0].round == 1
    assert one.actions == 2


class NoLeftTurns(WorldFutures):
    """Something is in the way of every turn to the left."""

    def imagine(self, candidates, over, sees=True):
        """Return what would be seen, with left turns blocked."""
        seen = super().imagine(candidates, over, sees)
        frees = [torch.tensor([name != "left" for name in names], dtype=torch.bool) for names in candidates]
        walks = [dataclasses.replace(walk, free=free) for walk, free in zip(seen.walks, frees, strict=True)]
        return dataclasses.replace(seen, walks=walks)


def test_blocked_actions_are_left_out_of_what_is_chosen(judge, model, situation):
    blocking = dataclasses.replace(judge(), model=NoLeftTurns(model, situation.ground))
    some, all_of_it = blocking.judge([["left", "forward", "left", "right"], ["left", "left"]], 1)
    assert (some.chosen, some.chosen_numbers) == (("forward", "right"), [1, 3])
    assert all_of_it.chosen == ("left", "left")  # what is known may be wrong


def test_a_search_goes_on_behind_the_blocked_actions_of_its_last_plan(judge, model, situation):
    blocking = dataclasses.replace(judge(), model=NoLeftTurns(model, situation.ground))
    planner = Cem(CemSettings(horizon=4, candidates=1, rounds=1, shift=0.5))
    best = planner.plan(situation, dataclasses.replace(blocking), seeded(2)).best
    assert 1 < len(best.chosen) < len(best.actions)
    planner.executed(1)
    done = best.chosen_numbers[1]
    following = planner.plan(situation, dataclasses.replace(blocking), seeded(9)).candidates[0].actions
    assert following == (*best.actions[done:], *best.actions[-1:] * done)


def test_what_ends_where_the_agent_has_looked_comes_last(judge, model, situation):
    looked = model.agents[0].cameras_after(AHEAD).world_from_camera[-1:].double()
    one = judge(looked=looked)
    there, beside, turned = one.judge([AHEAD, AHEAD[:2], (*AHEAD, "left", "left")], 1)
    assert there.cost > beside.cost == pytest.approx(0.4)
    assert turned.cost == pytest.approx(0.0, abs=1e-6)  # another view from the same place


def test_a_view_a_step_or_a_turn_beside_one_that_was_looked_at_comes_last_too(judge, model):
    looked = model.agents[0].cameras_after(AHEAD).world_from_camera[-1:].double()
    beside = judge(looked=looked).judge([AHEAD[:3], (*AHEAD, "left")], 1)
    assert all(candidate.cost >= LAST for candidate in beside)


def test_of_a_way_over_a_view_that_was_looked_at_the_best_other_frame_counts(judge, model):
    looked = model.agents[0].cameras_after(AHEAD).world_from_camera[-1:].double()
    over, turning = judge(looked=looked, over="best").judge([AHEAD, ("left",) * 4], 1)
    assert (over.cost, over.best) == (pytest.approx(0.4), 2)  # the frame after it is too near
    assert turning.cost == pytest.approx(0.8)


def test_frames_that_nobody_imagined_are_not_counted_but_use_up_a_budget(judge, situation):
    one = judge(budget=Budget(8))
    plan = Rank(make_policy("random", {}), RankSettings(4, 5)).plan(situation, one, seeded())
    assert (plan.frames, plan.judged, plan.exhausted) == (0, 8, True)
    pixels = dataclasses.replace(judge(), cost=PixelCost(None), goal=Goal(situation.seen.rgb[0], None, "room"))
    plan = Rank(make_policy("random", {}), RankSettings(2, 1)).plan(situation, pixels, seeded())
    assert (plan.frames, plan.judged) == (2, 2)


def test_costs_do_not_depend_on_the_batch(judge):
    sequences = dict.fromkeys(draw(torch.full((4, 3), 1 / 3), ["forward", "left", "right"], 9, seeded()))
    alone = [judge(batch=1).judge([names], 1)[0].cost for names in sequences]
    assert [candidate.cost for candidate in judge(batch=9).judge([*sequences], 1)] == pytest.approx(alone)


def test_the_cross_entropy_method_finds_the_way_and_a_seed_gives_the_same_plan(judge, situation):
    settings = CemSettings(horizon=4, candidates=30, rounds=6)
    rounds = []
    plan = Cem(settings).plan(situation, judge(), seeded(), lambda number, cost: rounds.append((number, cost)))
    assert plan.actions == AHEAD
    assert plan.best.cost == pytest.approx(0.0, abs=1e-6)
    assert [number for number, _ in rounds] == [1, 2, 3, 4, 5, 6]
    assert [cost for _, cost in rounds] == sorted((cost for _, cost in rounds), reverse=True)
    again = Cem(settings).plan(situation, judge(), seeded())
    assert [one.actions for one in again.candidates] == [one.actions for one in plan.candidates]


def test_what_is_left_of_a_plan_is_judged_again_beside_new_proposals(judge, situation):
    planner = Rank(make_policy("random", {}), RankSettings(4, 5, keep=True))
    first = planner.plan(situation, judge(), seeded())
    planner.executed(1)
    second = planner.plan(situation, judge(), seeded(1))
    assert second.candidates[0].actions == first.actions[1:]
    assert len(second.candidates) == 5
    planner.executed(4)
    assert len(planner.plan(situation, judge(), seeded(2)).candidates[0].actions) == 4  # nothing was left


def test_a_plan_that_is_kept_takes_the_place_of_one_proposal_of_the_first_round(judge, situation, monkeypatch):
    random, one, rounds = make_policy("random", {}), judge(), []
    planner, alone = (Rank(random, RankSettings(4, count, rounds=2, keep=True)) for count in (3, 1))
    kept = planner.plan(situation, judge(), seeded()).actions
    own = one.judge
    monkeypatch.setattr(one, "judge", lambda names, number: rounds.append(list(names)) or own(names, number))
    planner.plan(situation, one, seeded(1))
    assert [len(names) for names in rounds] == [3, 3]
    assert rounds[0][0] == kept != rounds[1][0]
    only = alone.plan(situation, judge(), seeded()).actions
    first = alone.plan(situation, judge(), seeded(1)).candidates
    assert [candidate.actions for candidate in first if candidate.round == 1] == [only]


def test_later_rounds_draw_what_the_elites_did(judge, situation):
    plan = Cem(CemSettings(horizon=4, candidates=60, rounds=5, smoothing=0.1)).plan(situation, judge(), seeded())
    means = [
        sum(one.cost for one in plan.candidates if one.round == number)
        / sum(one.round == number for one in plan.candidates)
        for number in (1, 2)
    ]
    assert means[1] < means[0]
    assert plan.judged < 5 * 60 * 4  # as the distributions narrow, sequences come again


def test_the_next_round_judges_a_share_of_the_elites_again_beside_its_own(judge, situation, monkeypatch):
    one, rounds = judge(), []
    own = one.judge
    monkeypatch.setattr(one, "judge", lambda names, number: rounds.append(list(names)) or own(names, number))
    Cem(CemSettings(horizon=4, candidates=20, rounds=2, elites=0.5, kept=0.4)).plan(situation, one, seeded())
    elites = sorted(rounds[0], key=lambda names: one.judged[names].cost)[:10]
    assert rounds[1][:4] == list(dict.fromkeys(elites))[:4]
    assert [len(candidates) for candidates in rounds] == [20, 20]


def test_a_policy_proposes_half_of_the_first_round(judge, situation):
    settings = CemSettings(horizon=4, candidates=8, rounds=1)
    plan = Cem(settings, make_policy("straight", {})).plan(situation, judge(), seeded())
    assert plan.candidates[0].actions == AHEAD
    assert plan.best.cost == pytest.approx(0.0, abs=1e-6)
    alone = Cem(settings).plan(situation, judge(), seeded())
    assert AHEAD not in [candidate.actions for candidate in alone.candidates]


def test_distributions_follow_how_often_each_action_was_drawn_among_the_elites(judge, situation):
    planner = Cem(CemSettings(horizon=1, candidates=20, rounds=1, elites=0.5, smoothing=0.25))
    planner.plan(situation, judge(), seeded())
    names, uniform = ["forward", "left", "right"], torch.full((1, 3), 1 / 3, dtype=torch.float64)
    elites = sorted(draw(uniform, names, 20, seeded()), key=lambda one: one != ("forward",))[:10]
    expected = 0.25 * uniform + 0.75 * frequencies(elites, names, uniform)
    assert planner._last.probabilities[0, 0] == pytest.approx(float(expected[0, 0]))


def test_what_a_policy_proposes_of_other_actions_is_not_searched(judge, situation):
    settings = CemSettings(horizon=2, candidates=6, rounds=1, actions=("left", "right"))
    plan = Cem(settings, make_policy("straight", {})).plan(situation, judge(), seeded())
    assert {name for one in plan.candidates for name in one.actions} == {"left", "right"}


def test_frequencies_are_shares_of_each_place():
    before = torch.full((3, 2), 0.5, dtype=torch.float64)
    shares = frequencies([("a", "b"), ("a", "a"), ("b", "a"), ("a",)], ["a", "b"], before)
    assert shares.tolist() == [[0.75, 0.25], [pytest.approx(2 / 3), pytest.approx(1 / 3)], [0.5, 0.5]]


def test_a_shifted_plan_goes_on_where_the_last_one_was_left(judge, situation):
    planner = Cem(CemSettings(horizon=4, candidates=30, rounds=4, shift=1.0, kept=0.5))
    planner.plan(situation, judge(), seeded())
    before, best, _ = planner._last
    planner.executed(1)
    probabilities, kept = planner._begin(["forward", "left", "right"])
    assert torch.equal(probabilities[:3], before[1:])
    assert probabilities[3].tolist() == pytest.approx([1 / 3] * 3)
    assert kept == [(*best[1:], best[-1])]
    following = judge()
    planner.plan(situation, following, seeded(1))
    assert next(iter(following.judged)) == kept[0]


@pytest.mark.parametrize("count", [4, 1_000_000])
def test_nothing_is_left_of_a_plan_that_was_done(judge, situation, count):
    planner = Cem(CemSettings(horizon=4, candidates=6, rounds=1, shift=0.5))
    planner.plan(situation, judge(), seeded())
    planner.executed(count)
    fresh = Cem(planner.settings).plan(situation, judge(), seeded(1))
    assert [one.actions for one in planner.plan(situation, judge(), seeded(1)).candidates] == [
        one.actions for one in fresh.candidates
    ]


def test_ranking_takes_the_proposal_of_least_cost(judge, situation):
    plan = Rank(make_policy("random", {}), RankSettings(4, 40)).plan(situation, judge(), seeded())
    assert len({candidate.actions for candidate in plan.candidates}) == len(plan.candidates) <= 40
    assert plan.best.cost == min(candidate.cost for candidate in plan.candidates) < 0.5
    more = Rank(make_policy("random", {}), RankSettings(4, 40, rounds=3)).plan(situation, judge(), seeded())
    assert len(more.candidates) > len(plan.candidates)
    assert more.rounds == 3


def test_a_budget_of_frames_is_kept_to_the_frame(judge, situation):
    plan = Cem(CemSettings(horizon=4, candidates=30, rounds=6)).plan(situation, judge(budget=Budget(50)), seeded())
    assert plan.exhausted
    assert plan.judged == 48
    with pytest.raises(PersistError, match="a budget of 3 frames does not suffice for one candidate of 4 actions"):
        Cem(CemSettings(horizon=4)).plan(situation, judge(budget=Budget(3)), seeded())


def test_a_budget_that_a_round_uses_up_ends_the_plan_there(judge, situation):
    settings, names = CemSettings(horizon=4, candidates=20, rounds=6), ["forward", "left", "right"]
    first = {*draw(torch.full((4, 3), 1 / 3, dtype=torch.float64), names, 20, seeded())}
    plan = Cem(settings).plan(situation, judge(budget=Budget(4 * len(first))), seeded())
    assert {candidate.actions for candidate in plan.candidates} == first
    assert (plan.rounds, plan.exhausted) == (1, True)


def test_a_budget_of_seconds_ends_a_plan_after_its_first_batch_at_least(judge, situation):
    one = judge(budget=Budget(seconds=1e-9), batch=5)
    plan = Rank(make_policy("random", {}), RankSettings(4, 40)).plan(situation, one, seeded())
    assert (len(plan.candidates), plan.exhausted) == (5, True)


def test_a_budget_of_seconds_leaves_out_what_would_take_longer_than_what_is_left(judge, monkeypatch):
    clock = itertools.count()  # each batch takes a second
    monkeypatch.setattr("persist_cli.planning.judge.time", SimpleNamespace(monotonic=lambda: next(clock)))
    one = judge(budget=Budget(seconds=3.25), batch=2)
    one.judge([*itertools.product(("left", "right"), repeat=4)], 1)
    assert (len(one.judged), one.seconds, one.exhausted) == (6, 3, True)


def test_each_batch_says_how_many_actions_it_had(judge):
    actions = []
    judge(batch=2, on_batch=actions.append).judge([AHEAD, AHEAD[:2], ("left",)], 1)
    assert actions == [6, 1]


@pytest.mark.parametrize(("budget", "cause"), [({"frames": 0}, "0 frames"), ({"seconds": 0.0}, "0 seconds")])
def test_a_budget_of_nothing_is_refused(budget, cause):
    with pytest.raises(PersistError, match=f"a budget of {cause}"):
        Budget(**budget)


def test_an_action_that_the_vocabulary_lacks_is_refused(judge, situation):
    with pytest.raises(DataError, match="unknown action 'leftt'; did you mean 'left'"):
        Cem(CemSettings(actions=("leftt",))).plan(situation, judge(), seeded())


def test_shares_that_are_none_are_refused():
    with pytest.raises(RecipeError, match=r"elites 0 is a share; it must lie above 0 and at most at 1"):
        parse_settings(CemSettings, {"elites": 0}, "cem")
    with pytest.raises(RecipeError, match=r"smoothing 1\.5 is a share; it must lie between 0 and 1"):
        parse_settings(CemSettings, {"smoothing": 1.5}, "cem")


class Undefined(Cost):
    """A cost that is not defined."""

    reads, sees, name = "place", False, "undefined"

    def measure(self, futures, goal, ground):
        return torch.full(futures.free.shape, torch.nan)


def test_a_cost_that_is_nan_is_one_line(judge):
    broken = dataclasses.replace(judge(), cost=Undefined(None))
    with pytest.raises(PersistError, match=r"cost 'undefined' of 'left\*2 forward' is NaN \(1 of 1 candidates\)"):
        broken.judge([["left", "left", "forward"]], 1)


class UndefinedAtFirst(Undefined):
    """A cost that is not defined for the first frame of a candidate."""

    def measure(self, futures, goal, ground):
        costs = torch.ones(futures.free.shape)
        costs[:, 0] = torch.nan
        return costs


def test_a_cost_that_is_nan_in_one_frame_of_several_is_said_too(judge):
    broken = dataclasses.replace(judge(over="best"), cost=UndefinedAtFirst(None))
    with pytest.raises(PersistError, match=r"is NaN \(2 of 2 candidates\)"):
        broken.judge([["left", "left"], ["right", "forward"]], 1)


def test_a_policy_that_needs_another_goal_is_refused(situation):
    class Shown(type(make_policy("random", {}))):
        reads = frozenset({"image"})

    policy = Shown(make_policy("random", {}).settings)
    policy.name = "shown"
    with pytest.raises(PersistError, match="policy 'shown' needs a goal with image; this goal has none"):
        check_goal(situation.goal, make_cost("distance", {}), policy)
    seen = dataclasses.replace(situation.goal, rgb=situation.seen.rgb[0])
    check_goal(seen, make_cost("distance", {}), policy)


def test_costs_and_policies_that_need_another_goal_are_refused(situation):
    with pytest.raises(PersistError, match="cost 'lpips' needs the image of the goal, which has none"):
        check_goal(situation.goal, make_cost("lpips", {}))
    image = Goal(torch.zeros(32, 32, 3, dtype=torch.uint8), None, "room")
    with pytest.raises(PersistError, match="cost 'distance' needs the place of the goal, which has none"):
        check_goal(image, make_cost("distance", {}))


def test_a_policy_that_does_not_look_so_far_is_refused():
    class Near(type(make_policy("random", {}))):
        longest = 5

    policy = Near(make_policy("random", {}).settings)
    policy.name = "near"
    with pytest.raises(PersistError, match="policy 'near' looks at most 5 actions ahead, not 8; give --horizon 5"):
        Rank(policy, RankSettings(horizon=8))
