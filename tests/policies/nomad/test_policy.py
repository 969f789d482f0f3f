"""The policy plugin ``nomad``: what it proposes, and how a trained policy is opened."""

from __future__ import annotations

import dataclasses
import shutil

import pytest
import torch

from persist_cli.api.ground import Cover, GroundMap
from persist_cli.api.policy import Goal, Situation
from persist_cli.data.store import Store
from persist_cli.errors import CheckpointError, PersistError, PluginError, RecipeError
from persist_cli.io.files import read_tensors
from persist_cli.policies.nomad.network import GoalPlace, NomadNetwork
from persist_cli.policies.nomad.policy import leaves_free
from persist_cli.policies.open_policy import open_policy
from persist_cli.policies.trained import find_policy, save_policy
from tests.support.rooms import UP


@pytest.fixture
def situation(walks) -> Situation:
    """An agent in the middle of a walk that shall reach what it sees at its end."""
    walk = Store(walks)[0].read()
    goal = Goal(walk.observations.rgb[-1], None, walk.info.scene)
    return Situation(walk.observations[9:12], walk.info, goal, GroundMap.empty(UP))


def draw(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def with_goal(situation: Situation, rgb: torch.Tensor | None) -> Situation:
    return dataclasses.replace(situation, goal=dataclasses.replace(situation.goal, rgb=rgb))


def test_it_proposes_ways_of_the_vocabulary_that_follow_from_the_seed(policy_run, situation):
    policy = open_policy(str(policy_run), {"stop": 0})
    assert (policy.name, policy.frames, policy.longest) == ("nomad", 3, 8)
    ways = policy.propose(situation, 6, 12, draw())
    assert len(ways) == 12
    assert all(1 <= len(way) <= 6 for way in ways)
    assert len(set(ways)) > 1
    assert {name for way in ways for name in way} <= {"forward", "left", "right"}
    assert ways == policy.propose(situation, 6, 12, draw())
    assert ways != policy.propose(situation, 6, 12, draw(1))


def test_the_folder_of_a_policy_and_another_checkpoint_are_refused(policy_run):
    with pytest.raises(PersistError, match=r"a trained policy; leave out policy\.checkpoint, or name its plugin"):
        open_policy(str(policy_run), {"checkpoint": "elsewhere"})


def test_without_an_image_it_goes_where_a_masked_goal_leads_whatever_the_goal(policy_run, situation):
    masked = open_policy(str(policy_run), {"masked": True}).propose(situation, 8, 6, draw())
    assert open_policy(str(policy_run)).propose(with_goal(situation, None), 8, 6, draw()) == masked
    other = with_goal(situation, 255 - situation.seen.rgb[0])
    assert open_policy(str(policy_run), {"masked": True}).propose(other, 8, 6, draw()) == masked


def test_it_stops_where_the_predicted_distance_says_so_but_not_where_it_explores(policy_run, situation):
    policy = open_policy(str(policy_run), {"stop": 1e6})
    assert policy.propose(situation, 8, 3, draw()) == [()] * 3
    assert all(policy.propose(with_goal(situation, None), 8, 3, draw()))


def test_near_a_goal_whose_place_is_certain_the_first_way_leads_there_and_turns_to_its_heading(
    policy_run, situation, monkeypatch
):
    place = GoalPlace(ahead=0.5, left=0.0, heading=30.0, certainty=0.8)
    monkeypatch.setattr(NomadNetwork, "goal_place", lambda network, condition: place)
    straight = ("forward", "forward", "left", "left")
    policy = open_policy(str(policy_run), {"stop": 0})
    first, *others = policy.propose(situation, 8, 5, draw())
    assert first == straight
    assert others == open_policy(str(policy_run), {"stop": 0, "arrive": 0}).propose(situation, 8, 4, draw())
    assert policy.propose(situation, 3, 1, draw()) == [straight[:3]]
    for settings in ({"arrive": 0.4}, {"sure": 0.9}, {"masked": True}):
        ways = open_policy(str(policy_run), {"stop": 0, **settings}).propose(situation, 8, 5, draw())
        assert len(ways) == 5
        assert ways[0] != straight


def test_ways_that_the_known_ground_leaves_free_come_first_and_nothing_known_is_gone_through(
    policy_run, situation, monkeypatch
):
    policy = open_policy(str(policy_run), {"stop": 0, "samples": 16})
    known = dataclasses.replace(situation, ground=wall_ahead(situation))
    ways = policy.propose(known, 8, 16, draw())
    free = leaves_free(known, [way[:4] for way in ways])
    assert free == sorted(free, reverse=True)
    assert {*free} == {True, False}
    assert sorted(ways) == sorted(policy.propose(situation, 8, 16, draw()))
    assert policy.propose(known, 8, 1, draw()) == ways[:1]

    place = GoalPlace(ahead=0.8, left=0.0, heading=0.0, certainty=1.0)
    monkeypatch.setattr(NomadNetwork, "goal_place", lambda network, condition: place)
    assert policy.propose(situation, 8, 1, draw()) == [("forward",) * 4]
    assert policy.propose(known, 8, 16, draw()) == ways


def wall_ahead(situation: Situation) -> GroundMap:
    """A ground map of which all is known: a wall lies 0.3 m ahead of the agent, all else is free."""
    ground = GroundMap.empty(UP)
    pose = situation.seen.cameras.world_from_camera[-1].double()
    place, heading = ground.places(pose[:3, 3]), ground.axes[:2] @ pose[:3, 2]
    squares = torch.cartesian_prod(torch.arange(80), torch.arange(80)).flip(1)
    ahead = (place - 2 + (squares + 0.5) * ground.spacing - place) @ heading
    states = torch.where((ahead > 0.3) & (ahead < 0.5), int(Cover.OCCUPIED), int(Cover.FREE)).to(torch.uint8)
    x, y = (place - 2).tolist()
    return dataclasses.replace(ground, states=states.view(80, 80), origin=(x, y))


def test_a_short_past_and_images_of_another_size_will_do(policy_run, situation):
    policy = open_policy(str(policy_run), {"stop": 0})
    first = dataclasses.replace(situation, seen=situation.seen[:1])
    repeated = dataclasses.replace(situation, seen=situation.seen[[0, 0, 0]])
    assert policy.propose(first, 4, 4, draw()) == policy.propose(repeated, 4, 4, draw())
    assert situation.goal.rgb is not None
    assert policy.propose(with_goal(situation, situation.goal.rgb.repeat(2, 2, 1)), 4, 1, draw())


def test_of_the_past_it_sees_frames_that_are_as_far_apart_as_in_training(policy_run, situation):
    policy = open_policy(str(policy_run), {"stop": 0})  # sees the present frame, and the second before it
    rgb, changes = situation.seen.rgb, []
    for number in range(3):
        changed = rgb.clone()
        changed[number] = 255 - changed[number]
        seen = dataclasses.replace(situation.seen, rgb=changed)
        changes.append(policy.distance(dataclasses.replace(situation, seen=seen)) != policy.distance(situation))
    assert changes == [True, False, True]


def test_fewer_denoising_steps_are_possible_and_more_are_refused(policy_run, situation):
    assert open_policy(str(policy_run), {"steps": 2, "stop": 0}).propose(situation, 8, 2, draw())
    with pytest.raises(RecipeError, match=r"steps 11; .* has 10 noise levels"):
        open_policy(str(policy_run), {"steps": 11})


def test_a_single_denoising_step_which_would_leave_all_noise_is_refused(policy_run):
    with pytest.raises(RecipeError, match="steps"):
        open_policy(str(policy_run), {"steps": 1})


def test_a_policy_opens_by_name_run_checkpoint_or_model_folder(policy_run):
    assert open_policy("random").name == "random"
    places = (policy_run, policy_run / "step-00000004", policy_run / "step-00000004/model")
    assert len({find_policy(place).fingerprint for place in places}) == 1
    assert find_policy(policy_run).training_scenes.names == {"room-0", "room-1"}


def test_a_policy_that_is_not_there_is_refused_in_one_line_that_says_what_to_do(tmp_path, policy_run, stage1):
    with pytest.raises(PluginError, match="unknown policy 'randm'; did you mean 'random'"):
        open_policy("randm")
    for place in (tmp_path, stage1, tmp_path / "missing"):
        with pytest.raises(CheckpointError, match=f"{place}: no trained policy there .*persist finetune houses-64"):
            open_policy(str(place))
    with pytest.raises(CheckpointError, match="no trained policy comes with this installation"):
        open_policy("nomad")


def test_a_policy_where_a_world_model_belongs_is_refused_in_one_line(persist, policy_run, walks):
    ended = persist("rollout", policy_run, "--start", f"{walks}#0:4", "--actions", "left", "--out", walks / "never")
    assert (ended.code, "a trained policy, no world model; name it as --policy" in ended.err) == (1, True)
    assert "a trained policy of 'nomad'" in persist("inspect", policy_run).out


def test_an_exported_policy_stands_alone_in_half_precision_and_acts_alike(persist, policy_run, situation, tmp_path):
    assert persist("export", policy_run, "--out", tmp_path / "policy").code == 0
    names = {path.name for path in (tmp_path / "policy").iterdir()}
    assert names == {"model.safetensors", "policy.json", "recipe.yaml", "SHA256SUMS"}
    weights = read_tensors(tmp_path / "policy/model.safetensors")[0]
    assert {value.dtype for value in weights.values()} == {torch.float16}
    ways = [
        open_policy(str(place), {"stop": 0}).propose(situation, 8, 8, draw())
        for place in (policy_run, tmp_path / "policy")
    ]
    assert sum(one == other for one, other in zip(*ways, strict=True)) >= 6
    ended = persist("export", policy_run, "--out", tmp_path / "other", "--steps", 4)
    assert (ended.code, "a policy has no adapters and no sampling" in ended.err) == (1, True)


def test_a_damaged_policy_is_refused(tmp_path, policy_run):
    shutil.copytree(policy_run / "step-00000004/model", tmp_path / "policy")
    weights = tmp_path / "policy/model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-7] + b"damaged")
    with pytest.raises(CheckpointError, match=r"model\.safetensors"):
        open_policy(str(tmp_path / "policy"))


def test_the_packaged_policy_acts_where_none_is_named(tmp_path, policy_run, situation, monkeypatch):
    monkeypatch.setenv("PERSIST_REFERENCE", str(tmp_path))
    (tmp_path / "policy").mkdir()
    trained = find_policy(policy_run)
    save_policy(trained.load(), "nomad", tmp_path / "policy", trained.training_scenes)
    ways = open_policy("nomad", {"stop": 0}).propose(situation, 8, 4, draw())
    assert ways == open_policy(str(policy_run), {"stop": 0}).propose(situation, 8, 4, draw())
