"""What a simulator answers wrongly is one line that names it, wherever it is asked, and no trajectory is left of it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from persist_cli.api.actions import free_motion, walking_actions
from persist_cli.api.observations import Frame, TrajectoryInfo
from persist_cli.api.simulator import Simulator
from persist_cli.data.images import decode_depth, encode_depth
from persist_cli.data.store import Store
from persist_cli.environments.simulated import SimulatedScenes, SimulatedSettings
from persist_cli.episodes.find_episodes import EpisodeSearch
from persist_cli.episodes.make_episodes import run_episodes
from persist_cli.errors import DataError, PluginError
from persist_cli.planning.futures import SimulatorFutures
from persist_cli.planning.true_futures import placed
from persist_cli.simulators.checked import checked_simulator
from persist_cli.simulators.collect import CollectPlan, run_collect
from tests.support.packages import install

PLAN = CollectPlan(simulator="hall", scenes="0:2", frames=24, size="8x8")
SIZE = {"height": 8, "width": 8}
SIDE = 4.0  # metres from the middle of the hall to its walls


class Hall(Simulator):
    """A dark empty hall, y up; it answers as a test says."""

    wrong: dict[str, Any] = {}  # noqa: RUF012  # set by a test: answers in the place of its own

    def open_scene(self, scene):
        """Open the same hall as ever."""

    def place(self, ground, heading):
        """Put the agent there."""
        self.ground, self.heading = ground, heading

    def with_settings(self, settings):
        """Another hall."""
        return self.wrong.get("with_settings", Hall(settings))

    @property
    def agent(self):
        """Where the agent is."""
        return self.wrong.get("agent", (self.ground, self.heading))

    @property
    def bounds(self):
        """The hall's corners."""
        return self.wrong.get("bounds", ((-SIDE, -SIDE), (SIDE, SIDE)))

    @property
    def info(self):
        """The camera."""
        height, width = self.settings.height, self.settings.width
        matrix = np.array([[8.0, 0, width / 2], [0, 8.0, height / 2], [0, 0, 1]])
        vocabulary = walking_actions(self.settings.step, self.settings.turn)
        own = TrajectoryInfo("hall", matrix, height, width, (0.0, 1.0, 0.0), vocabulary, {"simulator": "hall"})
        return self.wrong.get("info", replace(own, **self.wrong.get("change", {})))

    def is_free(self, ground):
        """Whether a place is in the hall."""
        return self.wrong.get("is_free", max(map(abs, ground)) < SIDE - 0.3)

    def ahead(self, heading):
        """Heading 0 looks along -z."""
        return self.wrong.get("ahead", lambda own: own)((-math.sin(heading), -math.cos(heading)))

    def act(self, action):
        """Walk and turn."""
        moved = self.info.vocabulary[action]
        x, z = (place - moved.forward * way for place, way in
                zip(self.ground, (math.sin(self.heading), math.cos(self.heading)), strict=True))  # fmt: skip
        allowed = max(abs(x), abs(z)) < SIDE - 0.3 and not moved.interaction
        if allowed:
            self.ground, self.heading = (x, z), self.heading + math.radians(moved.turn)
        return self.wrong.get("act", allowed)

    def movable(self):
        """No thing."""
        return self.wrong.get("movable", ())

    def cells(self):
        """None."""
        return self.wrong.get("cells")

    def observe(self):
        """A black picture."""
        pose, (x, z) = np.diag([1.0, -1.0, -1.0, 1.0]), self.ground
        turned = np.eye(4)
        turned[0, 0] = turned[2, 2] = math.cos(self.heading)
        turned[0, 2], turned[2, 0] = math.sin(self.heading), -math.sin(self.heading)
        pose = turned @ pose
        pose[:3, 3] = x, 1.25, z
        black = np.zeros((self.settings.height, self.settings.width, 3), np.uint8)
        own = Frame(black, np.ones(black.shape[:2], np.float32), pose)
        return self.wrong.get("observe", replace(own, **self.wrong.get("frame", {})))


@pytest.fixture
def hall(site: Path) -> None:
    """Install the hall as a simulator of another package."""
    install(site, "persist-hall", "persist.simulators", "hall = hall_world:Hall", f"from {__name__} import Hall")


@pytest.fixture
def collect(hall: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, collecting_here: None):
    """Collect a plan from a hall that gives some wrong answers."""

    def run(plan: CollectPlan = PLAN, **wrong: Any) -> None:
        monkeypatch.setattr(Hall, "wrong", wrong)
        run_collect(plan, tmp_path / "out", 1, json=True)

    return run


@pytest.mark.parametrize("policy", ["explore", "path", "loop", "there-and-back", "interact"])
def test_a_good_simulator_is_collected(collect, tmp_path: Path, policy: str) -> None:
    collect(replace(PLAN, policy=policy))
    assert [len(file) for file in Store(tmp_path / "out")] == [24, 24]


def test_a_policy_of_plans_is_no_walk_of_collect(collect) -> None:
    with pytest.raises(DataError, match=r"^policy 'straight' is for plans; collect walks with explore, path, "):
        collect(replace(PLAN, policy="straight"))


def test_answers_may_have_values_of_numpy(collect, tmp_path: Path) -> None:
    bounds = np.array([[-SIDE, -SIDE], [SIDE, SIDE]])
    collect(bounds=bounds, is_free=np.bool_(True), ahead=np.array, act=np.bool_(True))
    assert len(Store(tmp_path / "out")) == 2


@pytest.mark.parametrize(
    ("wrong", "cause"),
    [
        ({"info": None}, "the open scene: its info is None, no TrajectoryInfo"),
        ({"change": {"world_up": None}}, "the open scene: world_up None is not a unit vector of three numbers"),
        ({"change": {"source": None}}, "the open scene: its source is None, not a dictionary"),
        ({"change": {"vocabulary": free_motion()}}, "its vocabulary lacks forward, left, right; it has free"),
        ({"change": {"height": 4}}, "observe(): rgb is uint8 [8, 8, 3], not uint8 [4, 8, 3]"),
        ({"bounds": None}, "bounds is None, not the lowest and the highest ground corner in metres"),
        ({"bounds": ((-math.inf, 0), (math.inf, 1))}, "bounds is ((-inf, 0), (inf, 1)), not the lowest and"),
        ({"bounds": ((4, 4), (-4, -4))}, "bounds is ((4, 4), (-4, -4)), not the lowest and the highest"),
        ({"ahead": lambda own: None}, "ahead(0.0) returned None, not a unit vector on the ground"),
        ({"ahead": lambda own: (2.0, 0.0)}, "ahead(0.0) returned (2.0, 0.0), not a unit vector on the ground"),
        ({"is_free": None}, "is_free((0.0, 0.0)) returned None, no bool"),
        ({"agent": None}, "agent is None, not ((x, y), heading) in metres and radians"),
        ({"agent": (0.0, 0.0, 1.0)}, "agent is (0.0, 0.0, 1.0), not ((x, y), heading)"),
        ({"agent": ((math.nan, 0.0), 0.0)}, "agent is ((nan, 0.0), 0.0), not ((x, y), heading)"),
        ({"observe": None}, "observe() returned None, no Frame"),
        ({"frame": {"depth": None}}, "observe(): depth is None, no array of numpy"),
        ({"frame": {"world_from_camera": np.eye(4) * np.nan}}, "observe(): the pose is not finite"),
        ({"cells": "walls"}, "cells() returned 'walls', neither a CellGrid nor None"),
    ],
)
def test_a_wrong_answer_is_one_line_that_names_the_simulator(
    collect, tmp_path: Path, wrong: dict[str, Any], cause: str
) -> None:
    with pytest.raises(PluginError) as caught:
        collect(**wrong)
    assert str(caught.value).startswith(f"simulator 'hall' (persist-hall 1.2, hall_world:Hall) is broken: {cause}")
    assert "\n" not in str(caught.value)
    assert not list((tmp_path / "out").glob("*house*"))


def test_an_act_that_does_not_say_whether_it_was_allowed_is_refused(collect) -> None:
    with pytest.raises(PluginError, match=r"is broken: act\('\w+'\) returned None, no bool$"):
        collect(act=None)


def test_an_agent_that_goes_elsewhere_than_ahead_says_is_refused(collect) -> None:
    with pytest.raises(PluginError, match=r"is broken: 'forward' moved its agent by \(.*\) m, and ahead\(.*\) is \("):
        collect(replace(PLAN, scenes="0:6"), ahead=lambda own: (-own[0], own[1]))


@pytest.mark.parametrize("agent", [((0.5, 0.0), 3.0), ((3.0, 1.0), 0.0)])
def test_an_agent_that_is_put_elsewhere_is_refused(hall, monkeypatch: pytest.MonkeyPatch, agent: Any) -> None:
    simulator = checked_simulator("hall", SIZE)
    simulator.open_scene(0)
    simulator.place((0.5, 0.0), 2 * math.tau)  # as heading 0
    monkeypatch.setattr(Hall, "wrong", {"agent": agent})
    with pytest.raises(PluginError, match=r"is broken: place\(\(0.50, 0.00\), 0.00\) put its agent at \("):
        simulator.place((0.5, 0.0), 0.0)


@pytest.mark.parametrize("things", [None, [(0.0, 0.0, 0.0)], [1.0]])
def test_things_that_lie_nowhere_are_refused(collect, things: Any) -> None:
    with pytest.raises(PluginError, match=r"is broken: movable\(\) returned .*, not a sequence of ground positions"):
        collect(replace(PLAN, policy="interact"), movable=things)


def test_other_settings_must_give_a_simulator(collect) -> None:
    with pytest.raises(PluginError, match=r"is broken: with_settings\(\) returned None, no Simulator"):
        collect(replace(PLAN, turn="10:20"), with_settings=None)


def test_an_environment_checks_its_simulator(hall, monkeypatch: pytest.MonkeyPatch) -> None:
    houses = SimulatedScenes(SimulatedSettings(simulator="hall", scenes="0:1", size="8x8"))
    houses.begin(0, np.random.default_rng(0), {})
    assert houses.walk({0: ["left"]})[0][0].rgb.shape == (8, 8, 3)
    for wrong in ({"act": 1}, {"observe": None}, {"agent": None}):
        monkeypatch.setattr(Hall, "wrong", wrong)
        with pytest.raises(PluginError, match=rf"^simulator 'hall' .* is broken: {next(iter(wrong))}"):
            houses.walk({0: ["left"]})


def test_the_search_for_episodes_checks_its_simulator(hall, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Hall, "wrong", {"is_free": "yes"})
    with pytest.raises(PluginError, match=r"^simulator 'hall' .* is broken: is_free\(.*\) returned 'yes', no bool"):
        run_episodes(replace(PLAN, split="validation"), EpisodeSearch(), tmp_path / "episodes.json", json=True)
    assert not (tmp_path / "episodes.json").exists()


def test_a_simulator_as_a_model_is_checked(hall, monkeypatch: pytest.MonkeyPatch) -> None:
    simulator = checked_simulator("hall", SIZE)
    simulator.open_scene(0)
    simulator.place((0.0, 0.0), 0.0)
    future = SimulatorFutures(simulator)
    assert future.imagine([["forward", "left"]], "best").futures.rgb.shape == (1, 2, 8, 8, 3)
    monkeypatch.setattr(Hall, "wrong", {"frame": {"rgb": None}})
    with pytest.raises(PluginError, match=r"is broken: observe\(\): rgb is None, no array of numpy"):
        future.imagine([["forward", "left"]], "best")


def test_depth_that_is_none_is_missing_as_in_the_store(hall, monkeypatch: pytest.MonkeyPatch) -> None:
    depth = np.full((8, 8), 2.0, np.float32)
    depth[:3] = np.array([math.inf, math.nan, -1.0])[:, None]
    monkeypatch.setattr(Hall, "wrong", {"frame": {"depth": depth}})
    simulator = checked_simulator("hall", SIZE)
    simulator.open_scene(0)
    simulator.place((0.0, 0.0), 0.0)
    seen = simulator.observe().depth
    assert seen.dtype == np.float32
    assert np.array_equal(seen, decode_depth(encode_depth(depth)))


def test_a_stance_that_is_none_is_refused(hall, monkeypatch: pytest.MonkeyPatch) -> None:
    simulator = checked_simulator("hall", SIZE)
    assert simulator.stance(np.eye(4)) is None
    monkeypatch.setattr(Hall, "stance", lambda self, pose: (0.0, 0.0, 0.0))
    with pytest.raises(PluginError, match=r"is broken: stance\(\) returned \(0.0, 0.0, 0.0\), not \(\(x, y\)"):
        simulator.stance(np.eye(4))


def test_a_simulator_without_stance_is_said_to_lack_it_where_a_plan_asks_for_the_truth(collect, tmp_path) -> None:
    collect()
    now = next(iter(Store(tmp_path / "out"))).read().observations[:1]
    simulator = checked_simulator("hall", SIZE)
    assert placed(simulator, now) == (None, "simulator 'hall' cannot be put at a camera's pose: its stance() is None")


@pytest.mark.parametrize(("option", "setting"), [("height", "camera_height"), ("fov", "fov"), ("pitch", "pitch")])
def test_an_option_that_a_simulator_has_no_setting_for_is_named_as_an_option(
    collect, tmp_path: Path, option: str, setting: str
) -> None:
    cause = rf"^simulator 'hall' has no --{option}: there is no '{setting}' among its settings \(height, width, step, "
    with pytest.raises(DataError, match=cause):
        collect(replace(PLAN, **{option: "1"}))
    assert not (tmp_path / "out").exists()
