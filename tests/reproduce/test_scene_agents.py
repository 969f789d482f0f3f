"""Learning in houses made of one image: to the end by commands that persist has, resumed, and compared in a table."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from persist_cli.api.cells import CellOrigin
from persist_cli.errors import CheckpointError, PersistError
from persist_cli.io.files import write_json
from persist_cli.memorize.memory_file import load_memory
from persist_cli.reproduce import scene_agents
from persist_cli.reproduce.scene_agents import (
    Learning,
    Plan,
    images_of,
    main,
    make_memory,
    memorize_line,
    parse,
    practise,
    summarise,
    table,
    walk_of,
    write_results,
)
from tests.support.micro_runs import run_persist
from tests.support.micro_scenes import house_scene_model
from tests.support.miniworlds import make_world

pytest.importorskip("stable_baselines3", reason="it is in the extra dev")

MEMORIES = ("scene", "voxel", "simulator")


@pytest.fixture(scope="module")
def house_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene model to which all that was not seen is free."""
    return house_scene_model(tmp_path_factory.mktemp("models") / "free", "free")


@pytest.fixture(autouse=True)
def packaged(monkeypatch: pytest.MonkeyPatch, collecting_here: None) -> None:
    """The packaged world model, which draws scenes and maps; commands run in this process, and episodes are short."""
    monkeypatch.delenv("PERSIST_REFERENCE", raising=False)
    monkeypatch.setattr(scene_agents, "run_line", lambda line: run_persist(*shlex.split(line)))
    monkeypatch.setattr(scene_agents, "TRUE_AGENTS", 1)
    monkeypatch.setitem(scene_agents.TASK, "max_episode_steps", 4)


@pytest.fixture
def plan(house_model: Path, tmp_path: Path) -> Plan:
    return Plan(
        out=tmp_path / "my runs", model="reference", scene_model=str(house_model), memories=MEMORIES, houses=6,
        first=400, seeds=2, steps=4096, envs=8, episodes=100, denoising_steps=1,
    )  # fmt: skip


def keep(plan: Plan, house: int, memory: str, before: float, after: float) -> None:
    """Keep what came of the learnings of all seeds."""
    for seed in range(plan.seeds):
        outcome = {"before": before, "after": after, "without_goal": None if after > before else "shut in"}
        write_json(Learning(plan, house, memory, seed).result_file, outcome)


def test_policies_learn_in_a_scene_and_in_a_map_of_one_image_and_are_measured_in_the_true_house(
    house_model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_world()
    monkeypatch.setattr(scene_agents, "FRAMES", 4)
    out = tmp_path / "out"
    few = ["--houses", "1", "--seeds", "1", "--steps", "4", "--envs", "2", "--episodes", "1"]
    words = [str(out), "--scene-model", str(house_model), *few]
    main([*words, "--memories", "scene"])
    kept = {file: file.stat().st_mtime_ns for file in [*out.glob("*/scene/*"), *out.glob("views/*.parquet")]}
    main(words)
    assert {file: file.stat().st_mtime_ns for file in kept} == kept
    results = json.loads((out / "agents.json").read_text())
    assert [*results["memories"]] == [*MEMORIES]
    assert results["compared with"] == "voxel"
    assert not any(row["without_goal"] for row in results["memories"].values())
    learned = [json.loads(file.read_text()) for file in out.glob("learned/*/*.json")]
    assert len({one["image"] for one in learned}) == 1
    assert len({one["before"] for one in learned}) == 1  # the same policy in the same episodes of the same house
    with pytest.raises(PersistError, match=r"another plan \(steps: 4, now 8\)"):
        main([*words, "--steps", "8"])


def test_of_one_image_the_farthest_is_taken_and_of_several_the_first_of_the_walk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_world()
    monkeypatch.setattr(scene_agents, "FRAMES", 4)
    few = ["--houses", "1", "--seeds", "1", "--steps", "4", "--envs", "2", "--episodes", "1", "--memories", "none"]
    for images, frames in ((1, r":\d"), (3, ":0-3")):
        out = tmp_path / str(images)
        main([str(out), *few, "--images", str(images)])
        [learned] = [json.loads(file.read_text()) for file in out.glob("learned/*/*.json")]
        assert re.fullmatch(r".*#house-1000400" + frames, learned["image"])


def test_a_scene_may_hold_what_the_image_shows_alone_or_the_true_cells_of_the_house(
    plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_world()
    monkeypatch.setattr(scene_agents, "FRAMES", 4)
    run_persist(*shlex.split(f"collect miniworld --out '{plan.out}/views' --scenes 400:401 --frames 4 --split test"))
    seen, true, imagined = (Learning(plan, 400, name, 1) for name in ("scene:seen", "scene:true", "scene"))
    for learning in (true, imagined):
        make_memory(learning, images_of(learning))
    cells = {one: load_memory(one.memory_file).cells for one in (seen, true, imagined)}
    house = walk_of(true).cells(0)
    there = cells[true].box(house.corner, house.shape)
    assert torch.equal(there.classes[house.known], house.classes[house.known])
    origins = {one: set(cells[one].origins[cells[one].known].tolist()) for one in (seen, imagined)}
    assert (origins[seen], len(origins[imagined])) == ({int(CellOrigin.OBSERVED)}, 2)
    assert int(cells[seen].known.sum()) < int(cells[true].known.sum())


def test_houses_that_are_done_in_every_memory_stand_in_the_table_and_the_scene_is_compared_with_the_map(
    plan: Plan,
) -> None:
    for house in range(400, 406):
        keep(plan, house, "voxel", 0.1, 0.2 + 0.01 * (house % 2))
        keep(plan, house, "scene", 0.1, 0.5 + 0.01 * (house % 2))
    keep(plan, 400, "simulator", 0.1, 0.9)
    described = {"steps": 4096, "episodes": 100, "model": {"path": "reference", "fingerprint": "0" * 64}}
    write_results(plan, described)
    assert json.loads((plan.out / "agents.json").read_text())["houses"] == 1
    for house in range(401, 406):
        keep(plan, house, "simulator", 0.1, 0.9)
    write_results(plan, described)
    results = json.loads((plan.out / "agents.json").read_text())
    advantage = results["memories"]["scene"]["after − after with the memory compared with"]
    assert [advantage[key] for key in ("mean", "low", "high")] == pytest.approx([0.3] * 3)
    text = (plan.out / "agents.md").read_text()
    assert "| scene | 0.100 [0.100, 0.100] | 0.505 [" in text
    assert "after − after with voxel" in text


def test_few_houses_have_no_intervals_and_nothing_is_compared_with_itself() -> None:
    learned, shut_in = {"before": 0.0, "after": 0.5}, {"before": 0.5, "after": 0.5, "without_goal": "shut in"}
    results = summarise({"voxel": [[learned | {"without_goal": None}], [shut_in]]})
    described = {"steps": 1, "episodes": 1, "model": {"path": "reference", "fingerprint": "0" * 64}}
    text = table({"plan": described, "houses": 2, "seeds": 1} | results)
    assert "| voxel | 0.250 | 0.500 | +0.250 | – | 1 |" in text


def test_in_a_scene_that_shuts_the_agent_in_nothing_is_learned_and_the_reason_is_kept(tmp_path: Path) -> None:
    make_world()
    model = house_scene_model(tmp_path / "walls", "wall")
    plan = Plan(
        out=tmp_path / "out", model="reference", scene_model=str(model), memories=("scene",), houses=1, first=105,
        seeds=1, steps=4, envs=1, episodes=1, denoising_steps=1,
    )  # fmt: skip
    learning = Learning(plan, 105, "scene", 0)
    learning.memory_file.parent.mkdir(parents=True)
    run_persist(*shlex.split(memorize_line(learning, "sample#0:0")))
    outcome = practise(learning, "sample#0:0")
    assert outcome["before"] == outcome["after"]
    assert outcome["without_goal"] == "sample#0:0: its goal is within the success_radius of 1 m"  # where it stands


@pytest.mark.parametrize(
    ("words", "cause"),
    [
        (["--memories", " , "], "must be at least one each"),
        (["--images", "25"], "--images 25: give 1 to 24, the frames of the walk"),
        (["--memories", "scenes"], "no memory adapter 'scenes' in it"),
        (
            ["--memories", "scene:all"],
            "--memories scene:all: write an adapter of scenes before the colon, seen or true",
        ),
        (["--memories", "voxel:seen"], "--memories voxel:seen: write an adapter of scenes before the colon"),
        (["--scene-model", "nowhere"], "nowhere"),
    ],
)
def test_what_is_missing_is_said_before_anything_is_collected(words: list[str], cause: str, tmp_path: Path) -> None:
    with pytest.raises((PersistError, CheckpointError), match=cause):
        main([str(tmp_path / "out"), *words])
    assert not (tmp_path / "out").exists()


def test_the_image_whose_mean_depth_is_the_largest_shows_farthest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = parse([str(tmp_path)])
    depth = torch.stack([torch.full((4, 4), metres) for metres in (1.0, 2.0, 4.0, 3.0)])
    depth[1, 0, 0] = 20.0  # a single far pixel
    walk = SimpleNamespace(name="house", read=lambda: SimpleNamespace(observations=SimpleNamespace(depth=depth)))
    monkeypatch.setattr(scene_agents, "walk_of", lambda learning: walk)
    assert images_of(Learning(plan, 400, "voxel", 0)).endswith("#house:2")


@pytest.mark.parametrize("reason", [None, "shut in"])
def test_a_policy_is_measured_before_and_after_by_the_same_episodes_with_which_no_learning_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reason: str | None
) -> None:
    plan = parse([str(tmp_path)])
    measured: list[tuple[object, ...]] = []
    learned: list[int] = []

    def success_rate(policy: object, envs: object, episodes: int, seed: int) -> float:
        measured.append((envs, episodes, seed))
        return 0.25 * len(measured)

    agent = SimpleNamespace(learn=learned.append, ep_success_buffer=[1, 0, 0, 0])
    monkeypatch.setattr("stable_baselines3.PPO", lambda *_, **settings: agent)
    monkeypatch.setattr("stable_baselines3.common.vec_env.VecMonitor", lambda envs: envs)
    monkeypatch.setattr("persist_cli.environments.stable_baselines.BatchedVecEnv", lambda envs: envs)
    monkeypatch.setattr("persist_cli.environments.stable_baselines.success_rate", success_rate)
    monkeypatch.setattr(scene_agents, "imagined_house", lambda learning, image: "imagined")
    monkeypatch.setattr(scene_agents, "true_house", lambda house, count: house)
    monkeypatch.setattr(scene_agents, "missing_goal", lambda envs, seed: reason)
    outcome = practise(Learning(plan, 401, "voxel", 1), "image")
    assert {*measured} == {(401, 100, scene_agents.MEASURED)}
    assert plan.seeds < scene_agents.MEASURED
    after, practice = (0.25, None) if reason else (0.5, 0.25)
    assert (outcome["before"], outcome["after"], outcome.get("practice")) == (0.25, after, practice)
    assert (outcome["without_goal"], learned) == (reason, [] if reason else [plan.steps])
