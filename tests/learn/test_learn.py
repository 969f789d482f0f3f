"""A policy practises inside a micro model, learns from its walks, and goes on where it was stopped."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import yaml
from safetensors.torch import load_file, save_file

from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.api.ground import Body
from persist_cli.api.inference import InferenceOptions, SamplingOverrides
from persist_cli.api.policy import Goal, Policy
from persist_cli.checkpoints.load import adapter_memory, load_backbone
from persist_cli.data.store import Store, write_trajectory
from persist_cli.episodes.run_episode import LoopSettings
from persist_cli.learn.evaluation import mean_figures
from persist_cli.learn.learn import FIGURES, LearnPlan, open_place, prepare, report
from persist_cli.learn.places import ImaginedPlace
from persist_cli.learn.practice import PracticeSettings, PracticeWalk, Walker, ground_of, practise
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.plugins import make_policy
from persist_cli.policies.trained import find_policy
from persist_cli.rollout.world_model import Agent, WorldModel
from tests.conftest import CommandResult

SETTINGS = PracticeSettings(walks=3, actions=6, execute=3, explore=0.5, batch=2)

ONE = SamplingOverrides(steps=1, memory_guidance=1.0)

ONE_STEP = ["--steps", "1", "--guidance", "1"]


@pytest.fixture
def learn(persist, walks, policy_run, voxel, tmp_path) -> Callable[..., CommandResult]:
    """Runs a short learning in a micro model, with results in a folder of ``tmp_path``."""
    short = ["--walks", "3", "--actions", "10", "--execute", "4", "--training-steps", "2", "--rounds", "1"]
    training = ["--set", "training.batch=2", "--set", "training.workers=0"]

    def run(out: str, *more: str, data: Path = walks, frames: str = "0-12", model: Path = voxel) -> CommandResult:
        given = ["learn", model, "--views", f"{data}#0:{frames}", "--policy", policy_run, "--out", tmp_path / out]
        return persist(*given, *ONE_STEP, *short, *training, *more)

    return run


@pytest.fixture
def place(walks, voxel) -> ImaginedPlace:
    checkpoint = find_checkpoint(voxel)
    backbone, info = load_backbone(checkpoint, adapter="voxel").eval(), Store(walks)[0].info
    memory = MemoryFactory.of(adapter_memory(checkpoint, "voxel")).empty(info)
    memory.memorize(Store(walks)[0].read(range(12)).observations)
    return ImaginedPlace(WorldModel(backbone, [Agent(memory)], checkpoint.sampling_with(ONE)), info, {})


def walks_of(place: ImaginedPlace, views, seed: int) -> list[PracticeWalk]:
    random = make_policy("random", {})
    return list(practise(place, (random, random), views, SETTINGS, seed))


def test_a_walk_begins_at_a_given_view_and_each_frame_follows_from_its_action(place, walks):
    views = Store(walks)[0].read(range(12)).observations
    for walk in walks_of(place, views, seed=1):
        assert any(walk.seen.rgb[0].equal(view) for view in views.rgb)
        up, pose = torch.tensor(place.info.world_up).double(), walk.seen.cameras.world_from_camera
        for number, action in enumerate(walk.actions):
            moved = place.info.vocabulary.move(pose[number], action, up)
            assert torch.allclose(moved, pose[number + 1].double(), atol=1e-6)
        assert len(walk.actions) + walk.blocked == SETTINGS.actions


class OneOrThree(Policy):
    """A policy of proposals of one action or of three, as the draws say."""

    def propose(self, situation, horizon, count, generator) -> list[tuple[str, ...]]:
        long = torch.randint(0, 2, (count,), generator=generator).tolist()
        return [("forward",) * (3 if one else 1) for one in long]


def test_a_walk_that_is_done_waits_for_the_others_without_acting(place, walks):
    place.first.body = Body()
    views = Store(walks)[0].read(range(12)).observations
    settings, policy = PracticeSettings(walks=3, actions=16, execute=3, explore=0.0, batch=3), OneOrThree(None)
    found = list(practise(place, (policy, policy), views, settings, 1))
    assert sum(walk.blocked for walk in found) > 0
    assert [len(walk.actions) + walk.blocked for walk in found] == [16] * 3


class Proposes(Policy):
    """A policy of fixed proposals."""

    def __init__(self, *ways: str) -> None:
        super().__init__(None)
        self.ways = [tuple(way.split()) for way in ways]

    def propose(self, situation, horizon, count, generator) -> list[tuple[str, ...]]:
        return [self.ways[number % len(self.ways)] for number in range(count)]


def walker_towards(place, walks, metres: float, *ways: str, proposals: int = 3) -> Walker:
    """A walker whose goal is straight ahead of its start."""
    views = Store(walks)[0].read(range(12)).observations
    settings = PracticeSettings(walks=1, actions=16, execute=8, explore=0.0, proposals=proposals)
    walker = Walker(place, (Proposes(*ways), Proposes("right")), views, ground_of(views, place), settings, 1)
    camera = walker.seen.cameras
    ahead = camera.world_from_camera[0, :3, 2].double()
    walker.goal = Goal(walker.goal.rgb, camera.centers[0].double() + metres * ahead, place.info.scene)
    return walker


def test_of_several_proposals_that_one_is_done_that_leads_nearest_to_the_goal_as_far_as_there(place, walks):
    step = place.info.vocabulary["forward"].forward
    walker = walker_towards(place, walks, 4 * step, "left forward", "forward " * 7, "right right")
    assert walker.decide() == ("forward",) * 4
    alone = walker_towards(place, walks, 4 * step, "left forward", "forward " * 7, "right right", proposals=1)
    assert alone.decide() == ("left", "forward")


def test_whoever_practises_knows_the_ground_of_all_given_views_and_of_the_own_walk(place, walks):
    place.first.body = Body()
    walker = walker_towards(place, walks, 0.5, "forward")
    views = Store(walks)[0].read(range(12)).observations
    given = ground_of(views, place)
    assert given.map().states.equal(walker.mapper.map().states)
    alone = ground_of(walker.seen, place).map()
    assert int((given.map().states > 0).sum()) > int((alone.states > 0).sum())
    later = Store(walks)[1].read(range(12)).observations
    walker.saw(("forward",) * len(later), later, [True] * len(later))
    assert not given.map().states.equal(walker.mapper.map().states)
    assert given.map().states.equal(ground_of(views, place).map().states)


def test_a_goal_that_is_reached_is_followed_by_another_one(place, walks):
    walker = walker_towards(place, walks, 0.1, "left forward", "forward")
    reached = walker.goal
    assert walker.decide() == ("right",)
    assert (walker.goals, walker.goal is reached) == (2, False)


def test_practice_follows_from_its_seed_and_does_not_change_the_memory(place, walks):
    memory = place.first.memory
    views, before = Store(walks)[0].read(range(12)).observations, memory.tensors()
    first, again, other = (walks_of(place, views, seed) for seed in (1, 1, 2))
    assert [walk.actions for walk in first] == [walk.actions for walk in again]
    assert all(a.seen.rgb.equal(b.seen.rgb) for a, b in zip(first, again, strict=True))
    assert [walk.actions for walk in first] != [walk.actions for walk in other]
    assert all(tensor.equal(before[name]) for name, tensor in memory.tensors().items())


def test_walks_of_one_seed_differ_and_do_not_depend_on_the_batch(place, walks):
    views, policies = Store(walks)[0].read(range(12)).observations, (make_policy("random", {}),) * 2
    settings = [replace(SETTINGS, actions=4, batch=batch) for batch in (1, 2)]
    found = [[walk.actions for walk in practise(place, policies, views, one, 1)] for one in settings]
    assert found[0] == found[1]
    assert len(set(found[0])) == SETTINGS.walks


def test_frames_of_a_walk_have_the_action_after_each_and_a_blocked_one_leaves_none(place, walks):
    later = Store(walks)[0].read(range(4, 7)).observations
    walker = walker_towards(place, walks, 1.0, "forward")
    start = walker.seen
    walker.saw(("left", "forward", "right"), later, [True, False, True])
    walk = walker.walk()
    assert (walk.actions, walk.blocked, walker.taken) == (("left", "right"), 1, 3)
    frames = list(walk.frames())
    assert [(frame.action, frame.timestamp) for frame in frames] == [("left", 0), ("right", 1), (None, 2)]
    expected = [start.rgb[0], later.rgb[0], later.rgb[2]]
    assert all(torch.from_numpy(frame.rgb).equal(rgb) for frame, rgb in zip(frames, expected, strict=True))


def test_a_policy_that_practises_sees_the_last_frames_and_is_asked_for_as_many_actions_as_are_done(place, walks):
    asked = []

    class Looks(Policy):
        frames, longest = 3, 8

        def propose(self, situation, horizon, count, generator) -> list[tuple[str, ...]]:
            asked.append((situation.seen.rgb, horizon))
            return [("left",) * horizon] * count

    views = Store(walks)[0].read(range(12)).observations
    settings = replace(SETTINGS, actions=16, explore=0.0, proposals=1)
    walker = Walker(place, (Looks(None), Proposes("right")), views, ground_of(views, place), settings, 1)
    walker.saw(("left",) * 5, views[2:7], [True] * 5)
    assert walker.decide() == ("left",) * SETTINGS.execute
    ((seen, horizon),) = asked
    assert horizon == SETTINGS.execute
    assert seen.equal(views.rgb[4:7])


def test_each_walk_is_imagined_with_noise_of_its_own_and_ways_are_as_wide_as_the_body(place, walks):
    place.first.body = Body(radius=0.35)
    views, random = Store(walks)[0].read(range(12)).observations, make_policy("random", {})
    walkers = [Walker(place, (random, random), views, None, SETTINGS, seed) for seed in range(3)]
    seeds = [walker.sampling_seed for walker in walkers]
    place.begin([walker.seen for walker in walkers], seeds)
    assert [agent.seed for agent in place.world.agents] == seeds
    assert len(set(seeds)) == 3
    assert {walker.cost.settings.radius for walker in walkers} == {0.35}


@pytest.mark.parametrize("nowhere", [float("inf"), None])  # as measured, and as JSON has it
def test_figures_of_episodes_are_means_of_those_that_are_finite(nowhere):
    records = [{"figures": {"spl": spl, "end_metres": metres}} for spl, metres in ((0.1, 2.0), (0.2, nowhere))]
    assert mean_figures(records) == {"spl": pytest.approx(0.15, rel=1e-12), "end_metres": 2.0}


def test_a_round_leaves_walks_that_say_where_they_were_walked_and_a_policy_that_learned(learn, policy_run, tmp_path):
    assert learn("out").code == 0
    files = list(Store(tmp_path / "out/round-01/walks"))
    assert len(files) == 3
    assert files[0].info.source["practice"]["adapter"] == "voxel"
    results = json.loads((tmp_path / "out/learn.json").read_text())
    assert results["rounds"][1]["walked"] == 30
    recipe = yaml.safe_load((tmp_path / "out/round-01/policy/recipe.yaml").read_text())
    assert recipe["data"]["detour"] == 2
    before, after = (find_policy(run).load().parameters() for run in (policy_run, tmp_path / "out/round-01/policy"))
    assert not all(a.equal(b) for a, b in zip(before, after, strict=True))


def test_a_policy_practises_in_a_scene_whose_walls_stop_it(learn, cell_houses, scene_renderer, tmp_path):
    given = {"data": cell_houses, "model": scene_renderer, "frames": "0-20"}
    result = learn("out", "--actions", "24", "--proposals", "1", **given)
    assert result.code == 0, result.err
    assert json.loads((tmp_path / "out/round-01/walks.json").read_text())["blocked"] > 0
    for file in Store(tmp_path / "out/round-01/walks"):
        assert file.info.source["practice"]["adapter"] == "scene"
        places = file.poses()[:, [0, 2], 3].abs()
        assert 0.25 < float(places.min()) < float(places.max()) < 3.75  # inside the walls of the first room


def test_without_a_known_camera_height_nothing_stops_a_walk_unless_it_is_asked_for(walks, voxel, policy_run, tmp_path):
    plan = LearnPlan(
        views=(f"{walks}#0:0-12",), policy=str(policy_run), inside="model", checkpoint=voxel, adapter=None, rounds=1,
        practice=PracticeSettings(), steps=1, training=(), episodes=None, loop=LoopSettings(), sampling=ONE, seed=0,
    )  # fmt: skip
    for body in (None, True):
        learning = prepare(replace(plan, body=body), tmp_path / str(body))
        place = open_place(learning)
        place.begin([learning.views[:1]], [0])
        free = place.act({0: ["forward"] * 16})[0].free
        assert free.all() == (body is None)


def test_how_episodes_are_run_is_refused_without_episodes(learn, tmp_path):
    for options in (("--patience", "4"), ("--stop-cost", "0.2")):  # the first as it is by default
        result = learn("out", *options)
        assert (result.code, result.err) == (1, f"error: {options[0]}: only with --episodes, which are run so\n")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "cause"),
    [
        ([], "{walks}#0:0-12: of no simulator; leave --episodes and --inside simulator out"),
        (["--no-body"], "--no-body: nobody goes through walls of the true house; leave out --inside simulator"),
        (
            ["reference", "--adapter", "none", "--steps", "1", "--dtype", "float32"],
            "checkpoint, --adapter, --steps, --dtype: the true house needs no model and no memory; "
            "leave out --inside simulator",
        ),
    ],
)
def test_what_the_true_house_has_no_use_for_is_refused(persist, walks, policy_run, tmp_path, options, cause):
    given = ["--views", f"{walks}#0:0-12", "--policy", policy_run, "--out", tmp_path / "out", "--inside", "simulator"]
    result = persist("learn", *options, *given)
    assert (result.code, result.err) == (1, f"error: {cause.format(walks=walks)}\n")
    assert not (tmp_path / "out").exists()


def test_a_policy_in_a_folder_called_like_a_plugin_is_the_one_that_practises(learn, policy_run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(find_policy(policy_run).folder, "nomad")
    assert [learn(out, *given).code for out, given in (("one", ()), ("two", ("--policy", "./nomad")))] == [0, 0]
    one, two = (Store(tmp_path / out / "round-01" / "walks") for out in ("one", "two"))
    assert [file.actions() for file in one] == [file.actions() for file in two]
    assert all(torch.equal(mine.poses(), theirs.poses()) for mine, theirs in zip(one, two, strict=True))


def test_a_learning_that_was_stopped_ends_as_one_that_was_not(learn, tmp_path):
    for rounds, out in (("2", "whole"), ("1", "halves"), ("2", "halves")):
        assert learn(out, "--rounds", rounds).code == 0
    whole, halves = (find_policy(tmp_path / out / "round-02/policy").fingerprint for out in ("whole", "halves"))
    assert whole == halves


def test_a_learning_that_was_stopped_amid_its_walks_repeats_one_batch_and_ends_as_one_that_was_not(
    learn, tmp_path, monkeypatch
):
    batches = ("--walks", "5", "--batch", "2")
    assert learn("whole", *batches).code == 0
    written: list[str] = []

    def stops_at_the_fourth(path, *more):
        written.append(path.name)
        if len(written) == 4:
            raise KeyboardInterrupt
        return write_trajectory(path, *more)

    monkeypatch.setattr("persist_cli.learn.learn.write_trajectory", stops_at_the_fourth)
    assert learn("stopped", *batches).code == 130
    assert learn("stopped", *batches).code == 0
    assert written[4:] == [f"walk-{number:05d}.parquet" for number in (2, 3, 4)]
    whole, stopped = (tmp_path / out / "round-01" for out in ("whole", "stopped"))
    assert (stopped / "walks.json").read_text() == (whole / "walks.json").read_text()
    assert find_policy(stopped / "policy").fingerprint == find_policy(whole / "policy").fingerprint
    for one, other in zip(Store(whole / "walks"), Store(stopped / "walks"), strict=True):
        assert one.read().observations.rgb.equal(other.read().observations.rgb)


def test_a_folder_with_another_learning_is_refused(learn):
    assert learn("out").code == 0
    result = learn("out", "--seed", "5")
    assert result.code == 1
    assert result.err.endswith("holds another learning (seed: 0, now 5); choose another --out or delete it\n")


def test_a_learning_goes_on_in_a_folder_that_was_moved(learn, tmp_path):
    assert learn("out").code == 0
    policy = tmp_path / "out/round-01/policy"
    trained = [(file, file.stat().st_mtime_ns) for file in sorted(policy.rglob("*")) if file.is_file()]
    shutil.move(tmp_path / "out", tmp_path / "moved")
    assert learn("moved", "--rounds", "2").code == 0
    for file, written in trained:
        assert (tmp_path / "moved" / file.relative_to(tmp_path / "out")).stat().st_mtime_ns == written
    assert (tmp_path / "moved/round-02/policy").is_dir()


def test_a_folder_of_another_adapter_is_refused(learn, voxel):
    other = shutil.copytree(voxel, Path(voxel).with_name("other"))
    assert learn("out").code == 0
    file = next(other.rglob("adapter.safetensors"))
    weights = load_file(file)
    save_file({name: weight + 1 for name, weight in weights.items()}, file)
    result = learn("out", model=other)
    assert (result.code, "holds another learning (adapter sha256: " in result.err) == (1, True), result.err


def test_a_learning_does_not_go_on_with_edited_code_of_another_package(learn, monkeypatch):
    for code in ("as it was", "edited"):
        monkeypatch.setattr("persist_cli.plugin_code.code_of", lambda _, name, code=code: {"nomad": code}.get(name))
        result = learn("out")
    assert result.err.count("holds another learning (code policy nomad: as it was, now edited)") == result.code == 1


def test_a_learning_goes_on_with_views_that_were_moved_and_with_no_others(learn, walks, tmp_path):
    assert learn("out").code == 0
    assert learn("out", data=shutil.copytree(walks, tmp_path / "moved")).code == 0
    result = learn("out", frames="1-13")
    assert (result.code, "holds another learning (views fingerprint: " in result.err) == (1, True), result.err


def test_a_learning_goes_on_with_less_memory_and_not_in_another_precision(learn):
    assert learn("out", "--dtype", "bfloat16").code == 0
    assert learn("out", "--dtype", "bfloat16", "--save-memory", "vae-slicing").code == 0
    result = learn("out")
    assert (result.code, "holds another learning (sampling dtype: bfloat16, " in result.err) == (1, True), result.err


def test_walks_are_imagined_in_the_precision_that_is_asked_for(walks, voxel, policy_run, tmp_path):
    plan = LearnPlan(
        views=(f"{walks}#0:0-12",), policy=str(policy_run), inside="model", checkpoint=voxel, adapter=None, rounds=1,
        practice=PracticeSettings(), steps=1, training=(), episodes=None, loop=LoopSettings(), sampling=ONE, seed=0,
        placement=InferenceOptions(dtype="bfloat16"),
    )  # fmt: skip
    place = open_place(prepare(plan, tmp_path / "out"))
    assert isinstance(place, ImaginedPlace)
    assert {weight.dtype for weight in place.world.backbone.transformer.parameters()} == {torch.bfloat16}


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--dtype", "bfloat61", "unknown --dtype 'bfloat61'; did you mean 'bfloat16'?"),
        ("--inside", "dream", "a policy practises inside the model or the simulator"),
        ("--policy", "nowhere/policy", "no trained policy there"),
        ("--adapter", "voxle", "no memory adapter 'voxle' in it; it has voxel"),
        ("--sampler", "dim", "unknown sampler 'dim'"),
        ("--autoguidance", "3", "autoguidance of 3: this checkpoint has no guide"),
        ("--set", "policy.settings.channels=[8, 8]", "a round keeps its policy; set training.* and data.* alone"),
        ("--set", "base=elsewhere", "a round keeps its policy; set training.* and data.* alone"),
        ("--set", "training.bach=3", "--set: unknown key 'training.bach', did you mean 'training.batch'?"),
        (
            "--actions",
            "7",
            "the policy learns from 8 actions at once, and blocked ones do not count; give --actions 16",
        ),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(learn, tmp_path, option, value, message):
    result = learn("out", option, value)
    assert result.code == 1
    assert message in result.err
    assert result.err.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("mean", [None, math.nan])
def test_a_figure_that_no_episode_has_is_a_dash_in_the_table(tmp_path, capsys, mean):
    figures = dict.fromkeys(FIGURES, 0.5) | {"end_metres": mean}  # no way was known: NaN, and null in JSON
    row = {"round": 0, "walked": 0, "policy": "begin", "figures": figures}
    results = {"inside": "model", "views": 1, "scene": "house", "episodes": 1, "rounds": [row]}
    report(SimpleNamespace(episodes=[None], out=tmp_path), results, as_json=False)
    printed = capsys.readouterr().out
    assert printed.count("0.50") == len(FIGURES) - 1
    assert printed.count("–") == 2  # also for what is blocked in the round before practice
