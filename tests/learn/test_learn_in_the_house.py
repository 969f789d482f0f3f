"""Practice and evaluation in the true house, a small one of MiniWorld."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from persist_cli.api.checkpoint import CARD, find_checkpoint
from persist_cli.api.observations import Frame
from persist_cli.api.training_scenes import TrainingScenes
from persist_cli.data.store import Store, write_trajectory
from persist_cli.episodes.episodes import EpisodeSet
from persist_cli.episodes.find_episodes import EpisodeSearch, find_episodes
from persist_cli.episodes.run_episode import run_closed_loop
from persist_cli.errors import DataError
from persist_cli.io.files import read_json, write_json
from persist_cli.io.sha256sums import write_sums
from persist_cli.learn.learn import open_simulator
from persist_cli.metrics.lpips import ALEX, tensor_shapes
from persist_cli.policies.trained import find_policy, write_policy_card
from persist_cli.simulators.miniworld import MiniWorld
from tests.conftest import CommandResult
from tests.support.miniworlds import make_world
from tests.support.predictions import cache_random

HOUSE = 1_000_001  # of the test split, with one room

SIZE = {"height": 32, "width": 32}


@pytest.fixture(scope="module")
def world() -> MiniWorld:
    return make_world(**SIZE)


@pytest.fixture(scope="module")
def episodes(world: MiniWorld, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of one episode."""
    search, file = (
        EpisodeSearch(bins=(8,), each=1, walk_frames=4),
        tmp_path_factory.mktemp("episodes") / "episodes.json",
    )
    found = [episode for scene in find_episodes(world, [HOUSE], search) for episode in scene][:1]
    EpisodeSet(simulator="miniworld", settings=SIZE, split="test", seed=0, episodes=found).write(file)
    return file


def turned_views(world: MiniWorld, episodes: Path) -> Iterator[Frame]:
    """What the agent sees while it turns at the start of the episode."""
    at = EpisodeSet.model_validate_json(episodes.read_text()).episodes[0].start
    world.open_scene(HOUSE)
    world.place(at.ground, at.heading)
    for number in range(8):
        frame = world.observe()
        yield Frame(frame.rgb, frame.depth, frame.world_from_camera, "left" if number < 7 else None, float(number))
        world.act("left")


@pytest.fixture
def learn(persist, world, episodes, policy_run, tmp_path) -> Callable[..., CommandResult]:
    """Runs a short learning in the true house, with results in ``out``."""
    short = ["--walks", 2, "--actions", 10, "--execute", 5, "--training-steps", 1, "--rounds", 1, "--patience", 1]
    training = ["--set", "training.batch=2", "--set", "training.workers=0", "--inside", "simulator", "--json"]

    def run(*more: object, simulator: MiniWorld = world) -> CommandResult:
        simulator.open_scene(HOUSE)
        views, out = tmp_path / "views.parquet", tmp_path / "out"
        write_trajectory(views, simulator.info, turned_views(simulator, episodes))
        given = ["--views", f"{tmp_path}#views", "--policy", policy_run, "--episodes", episodes, "--out", out]
        return persist("learn", *given, *short, *training, *(more or ("--stop-cost", 0)))

    return run


def test_a_learning_that_was_stopped_before_its_last_evaluation_ends_as_one_that_was_not(learn, tmp_path):
    whole = learn()
    assert whole.code == 0, whole.err
    results = json.loads(whole.out)
    assert [row["walked"] for row in results["rounds"]] == [0, 20]
    assert all(0 <= row["figures"]["spl"] <= row["figures"]["success"] <= 1 for row in results["rounds"])
    walks = tmp_path / "out/round-01/walks"
    assert Store(walks)[0].info.source["practice"] == {"simulator": "miniworld"}
    written = [file.stat().st_mtime_ns for file in walks.iterdir()]
    for file in ("round-01/episodes.json", "learn.json", "success.png"):
        (tmp_path / "out" / file).unlink()
    first = tmp_path / "out/round-00/episodes.json"
    first.write_text('{"figures": {"soft_spl": 2.0}}')  # an older persist kept no metres of the start
    again = json.loads(learn().out)
    for row in (*results["rounds"], *again["rounds"]):
        for name in ("seconds_per_decision", "writing_per_decision"):
            row["figures"].pop(name)
    assert again == results
    assert [file.stat().st_mtime_ns for file in walks.iterdir()] == written
    assert (tmp_path / "out/success.png").is_file()


def test_an_evaluation_that_was_stopped_goes_on_after_its_last_episode(learn, episodes, tmp_path, monkeypatch):
    one = EpisodeSet.model_validate_json(episodes.read_text())
    more = [one.episodes[0].model_copy(update={"name": f"again-{seed}", "seed": seed}) for seed in range(3)]
    one.model_copy(update={"episodes": more}).write(tmp_path / "three.json")
    given = ("--episodes", tmp_path / "three.json", "--stop-cost", 0)
    assert learn(*given, "--out", tmp_path / "whole").code == 0
    run: list[str] = []

    def stops_at_the_third(scene, *more):
        run.append(scene.episode.name)
        if len(run) == 3:
            raise KeyboardInterrupt
        return run_closed_loop(scene, *more)

    monkeypatch.setattr("persist_cli.learn.evaluation.run_closed_loop", stops_at_the_third)
    assert learn(*given).code == 130
    first = tmp_path / "out/round-00/episodes.json"
    assert [record["episode"] for record in json.loads(first.read_text())["episodes"]] == ["again-0", "again-1"]
    assert learn(*given).code == 0
    assert run[3:] == ["again-2", "again-0", "again-1", "again-2"]  # the rest, and all after the round
    for file in ("round-00/episodes.json", "round-01/episodes.json", "learn.json"):
        whole, stopped = (untimed(json.loads((tmp_path / out / file).read_text())) for out in ("whole", "out"))
        assert str(stopped).replace(str(tmp_path / "out"), str(tmp_path / "whole")) == str(whole)


def untimed(value: Any) -> Any:
    """JSON values without the seconds that something took."""
    if isinstance(value, dict):
        return {key: untimed(item) for key, item in value.items() if not key.endswith("_per_decision")}
    return [untimed(item) for item in value] if isinstance(value, list) else value


def test_episodes_of_another_agent_than_that_of_the_views_are_refused(learn, tmp_path):
    result = learn(simulator=make_world(**SIZE, step=0.4, turn=30.0))
    assert (result.code, result.err.count("\n")) == (1, 1)
    assert "with step 0.25 and turn 15.0, the views were collected with step 0.4 and turn 30.0" in result.err
    assert not (tmp_path / "out").exists()


def test_a_house_that_the_policy_was_trained_on_is_evaluated_only_where_that_is_allowed(
    learn, world, episodes, policy_run, tmp_path
):
    (scene,) = EpisodeSet.model_validate_json(episodes.read_text()).scenes
    known = Path(shutil.copytree(find_policy(policy_run).folder, tmp_path / "known"))
    trained = find_policy(known)
    write_policy_card(known, trained.plugin, trained.settings, TrainingScenes(frozenset({scene})))
    write_sums(known)
    result = learn("--policy", known, "--stop-cost", 0)
    assert (result.code, result.err.count("\n")) == (1, 1)
    assert f"scene {scene!r}: policy {str(known)!r} was trained on it; take episodes of another split" in result.err
    assert not (tmp_path / "out").exists()
    allowed = learn("--policy", known, "--stop-cost", 0, "--allow-training-scenes")
    assert json.loads(allowed.out)["allow_training_scenes"], allowed.err


def test_a_house_that_the_model_was_trained_on_is_not_evaluated(learn, episodes, stage1, tmp_path):
    (scene,) = EpisodeSet.model_validate_json(episodes.read_text()).scenes
    known = Path(shutil.copytree(find_checkpoint(stage1).folder, tmp_path / "known"))
    scenes = {"training_scenes": TrainingScenes(frozenset({scene})).to_json()}
    write_json(known / CARD, read_json(known / CARD) | scenes)
    write_sums(known)
    result = learn(known, "--inside", "model", "--stop-cost", 0)
    assert (result.code, f"scene {scene!r}: the model was trained on it" in result.err) == (1, True), result.err
    assert not (tmp_path / "out").exists()


def test_the_evaluated_agent_stops_where_its_view_is_like_the_goal_image(learn, tmp_path, monkeypatch):
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path / "cache"))
    cache_random(tmp_path / "cache", "lpips-alex", tensor_shapes(ALEX))
    assert learn("--stop-cost", 1000).code == 0  # any view is
    for number in (0, 1):
        episode = json.loads((tmp_path / f"out/round-{number:02d}/episodes.json").read_text())["episodes"][0]
        assert (episode["ended"], episode["actions"]) == ("stopped", "")


def test_weights_that_are_missing_are_an_error_before_anything_is_done(learn, tmp_path, monkeypatch):
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path / "cache"))
    result = learn("--stop-cost", 0.15)
    assert (result.code, result.err.count("\n")) == (1, 1)
    assert "persist weights fetch lpips-alex; or --stop-cost 0, to stop only where the policy does" in result.err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("look", [{"light": 0.3}, {"depth_sensor": "kinect"}])
def test_views_of_another_look_are_refused_where_the_true_house_is_looked_at(
    world: MiniWorld, look: dict[str, Any]
) -> None:
    world.open_scene(HOUSE)
    info = replace(world.info, source=world.info.source | {"camera": look})
    plan: Any = SimpleNamespace(views=("dark#0",))
    open_simulator(plan, world.info)
    with pytest.raises(DataError, match=f"dark#0: collected with {next(iter(look))} of their own, which the true"):
        open_simulator(plan, info)
