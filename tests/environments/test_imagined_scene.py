"""A house that a scene model imagined from one image, as an environment."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import pytest
from gymnasium.utils.env_checker import check_env

import persist_cli.environments  # noqa: F401  registers them
from tests.support.micro_runs import run_persist


@pytest.fixture(scope="module")
def house(cell_houses: Path, scene_model: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene made of a single image."""
    file = tmp_path_factory.mktemp("scenes") / "house.safetensors"
    image = f"{cell_houses}#0:0"
    run_persist("memorize", image, "--memory", "scene", "--model", str(scene_model), "--complete", "--out", str(file))
    return file


def test_an_agent_can_walk_in_a_scene_that_was_made_of_one_image(
    house: Path, cell_houses: Path, scene_renderer: Path
) -> None:
    env = gymnasium.make(
        "persist/ImaginedHouse-v0", checkpoint=str(scene_renderer), memory=str(house), start=f"{cell_houses}#0:0",
        goal=[2.5, 1.25, -2.0], collide=True, sampling={"steps": 1}, success_radius=0.1, goal_distance=[0.15, 9.0],
        observe_goal="place",
    )  # fmt: skip
    check_env(env.unwrapped)
    seen, info = env.reset(seed=0)
    assert seen["rgb"].shape == (32, 32, 3)
    assert info["distance"] > 0.1


def test_goals_may_be_kept_to_the_ground_that_the_image_shows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PERSIST_REFERENCE", raising=False)
    file = tmp_path / "house.safetensors"
    run_persist("memorize", "sample#0:0", "--memory", "scene", "--complete", "--out", str(file))
    ahead = {}
    for goal in ("random", "seen"):
        house = gymnasium.make(
            "persist/ImaginedHouse-v0", memory=str(file), adapter="scene", start="sample#0:0", goal=goal,
            observe_goal="place",
        ).unwrapped.scenes  # fmt: skip
        camera = house.starts.file.poses()[0].double()
        ahead[goal] = (house.goals.positions - camera[:3, 3]) @ camera[:3, 2]
    assert 0 < len(ahead["seen"]) < len(ahead["random"])
    assert float(ahead["seen"].min()) > -0.5 > float(ahead["random"].min())
