"""``persist plan`` on micro models: what it leaves, and what it refuses."""

import errno
import json
import math

import numpy as np
import pytest
import torch
from PIL import Image

from persist_cli.api.ground import ground_axes
from persist_cli.output.video import read_video
from tests.support.damage import write_huge_image
from tests.support.micro_runs import SIZE
from tests.support.packages import install
from tests.support.rooms import UP, Room, look

SMALL = ("--steps", 1, "--candidates", 6, "--rounds", 2, "--horizon", 3)


@pytest.fixture
def plan(persist, voxel, walks, tmp_path):
    """Return a function that plans from a frame of a walk and returns what the command printed."""

    def run(*options, start=f"{walks}#0:2", goal=f"{walks}#0:5", out=tmp_path / "plan"):
        return persist("plan", voxel, "--start", start, "--goal", goal, "--out", out, *SMALL, *options)

    return run


@pytest.fixture
def memory(persist, voxel, walks, tmp_path):
    """A memory of the walk's scene that the model reads."""
    path = tmp_path / "walk.safetensors"
    assert persist("memorize", f"{walks}#0:0-8", "--checkpoint", voxel, "--out", path).code == 0
    return path


def test_a_plan_leaves_its_candidates_a_sheet_a_map_and_a_video(plan, memory, tmp_path):
    result = plan("--cost", "distance", "--memory", memory)
    assert result.code == 0, result.err
    record = json.loads((tmp_path / "plan/plan.json").read_text())
    costs = [candidate["cost"] for candidate in record["candidates"]]
    assert costs == sorted(costs)
    assert record["candidates"][0]["actions"] == record["text"]
    assert len(record["actions"]) == 3
    assert [one["round"] for one in record["rounds"]] == [1, 2]
    assert record["rounds"][1]["least_cost"] == record["least_cost"] == costs[0]
    assert np.shape(record["candidates"][0]["final_pose"]) == (4, 4)
    assert len(read_video(tmp_path / "plan/plan.mp4", 64, 192)) == 4
    assert Image.open(tmp_path / "plan/sheet.png").size[1] > 5 * 96
    assert Image.open(tmp_path / "plan/map.png").size[0] > 300
    assert "chosen: " in result.out
    assert "what is really there is left out: the data is no simulator's" in result.out


def test_a_seed_gives_the_same_plan_with_or_without_a_table(plan, tmp_path):
    first, second = (plan("--cost", "distance", "--json", out=tmp_path / name) for name in ("a", "b"))
    one, two = (json.loads(result.out) for result in (first, second))
    assert one["candidates"] == two["candidates"]


def test_a_log_shows_the_best_cost_after_each_round(plan, monkeypatch):
    for seconds in ("FIRST_LINE", "LINE_EVERY"):
        monkeypatch.setattr(f"persist_cli.output.console.{seconds}", 0.0)  # every line is due
    result = plan("--cost", "distance", "--json")
    assert result.code == 0, result.err
    for number, one in enumerate(json.loads(result.out)["rounds"], 1):
        assert f", round {number} of 2, best cost {one['least_cost']:.4g}\n" in result.err


def test_a_ranked_policy_towards_a_place_on_the_map(plan, tmp_path):
    result = plan("--method", "rank", "--policy", "straight", "--set", "cost.unknown=1.5", goal="1.0,-0.5")
    assert result.code == 0, result.err
    record = json.loads((tmp_path / "plan/plan.json").read_text())
    assert record["cost"] == {"name": "geodesic", "settings": {"unknown": 1.5, "radius": 0.2}, "over": "last"}
    assert record["policy"]["name"] == "straight"
    assert record["goal"]["kinds"] == ["place"]


def test_in_a_capture_ways_are_straight_as_nobody_knows_the_floor_that_could_be_in_the_way(plan, tmp_path):
    (tmp_path / "low").mkdir()
    low = Room(SIZE, SIZE).write(tmp_path / "low/low.parquet", np.stack([look((-2.0, 0.7, -0.5), -90.0)] * 2))
    options = ("--cost", "geodesic", "--set", "cost.unknown=1", "--batch", 5, "--step", 0.2, "--turn", 30)
    result = plan(*options, start=f"{low.parent}#0:0", goal="1.0,0.5")
    assert result.code == 0, result.err
    record = json.loads((tmp_path / "plan/plan.json").read_text())
    for candidate in record["candidates"]:
        place = ground_axes(UP) @ torch.tensor(candidate["final_pose"], dtype=torch.float64)[:3, 3]
        straight = math.dist(place[:2].tolist(), (1.0, 0.5))
        assert straight - 0.1 < candidate["cost"] < 1.1 * straight + 0.1
    assert (record["step"], record["turn"], record["batch"]) == (0.2, 30.0, 5)


def test_a_policy_sees_the_frames_before_the_start(plan, walks, site, tmp_path):
    counts = """
        from persist_cli.api.policy import Policy

        class Counts(Policy):
            frames = 5
            def propose(self, situation, horizon, count, generator):
                return [("left",) * min(horizon, len(situation.seen))] * count
    """
    install(site, "persist-counts", "persist.policies", "counts = counts:Counts", counts)
    for frame, seen in ((1, 2), (9, 5)):
        options = ("--method", "rank", "--policy", "counts", "--cost", "distance", "--horizon", 8)
        out = tmp_path / f"{frame}"
        assert plan(*options, start=f"{walks}#0:{frame}", out=out).code == 0
        assert json.loads((out / "plan.json").read_text())["text"] == f"left*{seen}"


def test_a_model_without_memory_plans_with_the_paths_alone_on_its_map(plan, tmp_path):
    result = plan("--cost", "distance", "--over", "best", "--adapter", "stage1", "--no-body", "--frames", 12)
    assert result.code == 0, result.err
    record = json.loads((tmp_path / "plan/plan.json").read_text())
    assert (record["adapter"], record["judged_actions"], record["ended_by_budget"]) == (None, 12, True)
    assert (record["imagined_videos"], record["imagined_frames"]) == (0, 0)
    assert "4 candidates of 12 actions, judged by their poses alone, in" in result.out
    assert "ended by the budget" in result.out
    assert (tmp_path / "plan/map.png").stat().st_size > 0


def test_an_image_of_another_size_is_resized_and_said_so(plan, tmp_path, monkeypatch):
    from persist_cli.metrics.lpips import ALEX, tensor_shapes
    from tests.support.predictions import cache_random

    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path / "cache"))
    cache_random(tmp_path / "cache", "lpips-alex", tensor_shapes(ALEX))
    Image.new("RGB", (100, 80), "red").save(tmp_path / "goal.png")
    (tmp_path / "goal.png").rename(tmp_path / "goal#1.png")
    result = plan(goal=tmp_path / "goal#1.png")
    assert result.code == 0, result.err
    assert f"resized from 100×80 to {SIZE}×{SIZE} pixels" in result.err
    assert json.loads((tmp_path / "plan/plan.json").read_text())["cost"]["name"] == "lpips"


PLACE = ("--cost", "distance")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--method", "cen"), "unknown --method 'cen'; did you mean 'cem'?"),
        (("--cost", "lpipss"), "unknown cost 'lpipss'; did you mean 'lpips'?"),
        (("--method", "rank", "--policy", "rando"), "unknown policy 'rando'; did you mean 'random'?"),
        (("--over", "lst"), "unknown --over 'lst'; did you mean 'last'?"),
        ((*PLACE, "--frames", 0), "a budget of 0 frames imagines nothing"),
        ((*PLACE, "--frames", 2), "a budget of 2 frames does not suffice for one candidate of 3 actions"),
        ((*PLACE, "--seconds", 0), "a budget of 0 seconds"),
        ((*PLACE, "--actions", "forward,jump"), "unknown action 'jump'"),
        ((*PLACE, "--set", "policy.weights={left: 1}"), "policy.weights: no policy proposes here; name one"),
        ((*PLACE, "--set", "method.elites=2"), "elites 2 is a share"),
        ((*PLACE, "--set", "method.shift=0.5"), "method.shift acts between one plan and the next, and this command"),
        ((*PLACE, "--method", "rank", "--set", "method.keep=true"), "method.keep acts between one plan and the next"),
        ((*PLACE, "--set", "elites=2"), "write method.KEY=VALUE or policy.KEY=VALUE or cost.KEY=VALUE"),
        ((*PLACE, "--method", "rank", "--actions", "left"), "--actions are those that --method cem chooses from"),
    ],
)
def test_options_that_cannot_be_used_are_one_line_and_leave_nothing(plan, tmp_path, options, message):
    result = plan(*options)
    assert (result.code, result.out) == (1, "")
    assert message in result.err
    assert len(result.err.splitlines()) == 1
    assert not (tmp_path / "plan").exists()


@pytest.mark.parametrize("method", ["rank", "cem"])
def test_a_policy_that_does_not_look_so_far_is_one_line_and_leaves_nothing(plan, site, tmp_path, method):
    near = """
        from persist_cli.api.policy import Policy

        class Near(Policy):
            longest = 2
            def propose(self, situation, horizon, count, generator):
                return [("left",) * horizon] * count
    """
    install(site, "persist-near", "persist.policies", "near = near:Near", near)
    result = plan(*PLACE, "--method", method, "--policy", "near")
    assert (result.code, result.out, len(result.err.splitlines())) == (1, "", 1)
    assert "policy 'near' looks at most 2 actions ahead, not 3; give --horizon 2" in result.err
    assert not (tmp_path / "plan").exists()


def install_cost(site, name, value):
    """Install a cost under a name; whatever is planned costs the given expression of torch."""
    source = f"""
        import torch
        from persist_cli.api.cost import Cost

        class Same(Cost):
            reads, sees = "place", False
            def measure(self, futures, goal, ground):
                return torch.full(futures.free.shape, {value})
    """
    install(site, f"persist-{name}", "persist.costs", f"{name} = {name}:Same", source)


def test_a_cost_that_is_nan_is_one_line_and_leaves_nothing(plan, site, tmp_path):
    install_cost(site, "undefined", "torch.nan")
    result = plan("--cost", "undefined")
    assert (result.code, result.out, len(result.err.splitlines())) == (1, "", 1)
    assert "cost 'undefined' of " in result.err
    assert " is NaN (" in result.err
    assert not (tmp_path / "plan").exists()


def test_a_cost_that_is_infinite_is_null_in_the_file(plan, site, tmp_path):
    install_cost(site, "endless", "torch.inf")
    result = plan("--cost", "endless")
    assert result.code == 0, result.err
    record = json.loads((tmp_path / "plan/plan.json").read_text())
    assert {candidate["cost"] for candidate in record["candidates"]} == {record["least_cost"]} == {None}
    assert " inf " in result.out


def test_a_plan_that_cannot_be_written_leaves_nothing_or_the_whole_plan_before(plan, tmp_path, monkeypatch):
    def full(*anything):
        raise OSError(errno.ENOSPC, "No space left on device", "map.png")

    out = tmp_path / "plans"
    with monkeypatch.context() as changed:
        changed.setattr("persist_cli.planning.outputs.draw_candidates", full)
        assert plan(*PLACE, out=out).code == 1
    assert not list(tmp_path.glob("*plans"))
    assert plan(*PLACE, out=out).code == 0
    before = {file.name: file.read_bytes() for file in out.iterdir()}
    monkeypatch.setattr("persist_cli.planning.outputs.draw_candidates", full)
    result = plan(*PLACE, "--seed", 1, out=out)
    assert (result.code, "No space left on device" in result.err) == (1, True)
    assert {file.name: file.read_bytes() for file in out.iterdir()} == before


@pytest.mark.parametrize(
    ("goal", "options", "message"),
    [
        ("{walks}#1:5", PLACE, "is of scene 'room-1', start and memory are of 'room-0'"),
        ("missing.png", (), "--goal missing.png: no such image; give an image file, a frame DATA#trajectory:frame"),
        ("{tmp}/text.png", (), "not a whole image"),
        ("{tmp}/large.png", (), "not a whole image (Image size (900000000 pixels) exceeds limit"),
        ("1.0,2.0", ("--cost", "lpips"), "cost 'lpips' needs the image of the goal, which has none; give an image"),
        ("300,0", (), "m from all that is known, which is too far to plan a way; name a place within 50 m of it (the"),
        ("{tmp}/goal.png", PLACE, "cost 'distance' needs the place of the goal, which has none; give a place"),
    ],
)
def test_goals_that_cannot_be_used_are_one_line_and_leave_nothing(plan, walks, tmp_path, goal, options, message):
    (tmp_path / "text.png").write_text("no image")
    write_huge_image(tmp_path / "large.png")
    Image.new("RGB", (SIZE, SIZE)).save(tmp_path / "goal.png")
    result = plan(*options, goal=goal.format(walks=walks, tmp=tmp_path))
    assert (result.code, result.out) == (1, "")
    assert message in result.err
    assert not (tmp_path / "plan").exists()


def test_a_memory_of_another_scene_is_one_line(plan, memory, walks):
    result = plan(*PLACE, "--memory", memory, start=f"{walks}#1:2", goal=f"{walks}#1:5")
    assert result.code == 1
    assert "its reference is 'room-0', wanted here is 'room-1'" in result.err


def test_in_a_scene_the_wall_behind_the_agent_stops_plans_though_no_frame_of_theirs_shows_it(
    persist, cell_houses, scene_renderer, tmp_path
):
    scene, place = tmp_path / "house.safetensors", {}
    made = persist("memorize", f"{cell_houses}#0", "--checkpoint", scene_renderer, "--out", scene)
    assert made.code == 0, made.err
    before = scene.read_bytes()
    for name, memory in (("known", ("--memory", scene)), ("unknown", ())):
        back = ("--actions", "backward", "--horizon", 8, "--candidates", 2, "--rounds", 1, "--steps", 1)
        goal = ("--start", f"{cell_houses}#0:0", "--goal=-1.5,2", "--cost", "distance", *memory)
        result = persist("plan", scene_renderer, *goal, *back, "--out", tmp_path / name)
        assert result.code == 0, result.err
        record = json.loads((tmp_path / name / "plan.json").read_text())
        place[name] = record["candidates"][0]["final_pose"][0][3]
    assert place["unknown"] == pytest.approx(1.25 - 8 * 0.25)
    assert 0.3 < place["known"] < 0.7  # the middle of the wall is at 0
    assert scene.read_bytes() == before
