"""Costs on random weights, and on places that can be computed by hand."""

import json
import math
from dataclasses import replace

import pytest
import torch

from persist_cli.api.cost import Futures
from persist_cli.api.ground import Body, Cover, GroundMap, ground_axes
from persist_cli.api.policy import Goal
from persist_cli.errors import PersistError
from persist_cli.metrics import METRICS, dreamsim
from persist_cli.metrics.lpips import ALEX, tensor_shapes
from persist_cli.plugins import load_plugin, make_cost
from tests.metrics.test_src import cache_random_encoder
from tests.support.predictions import cache_random, prediction, random_frames, still_camera

GROUND = GroundMap.empty((0.0, -1.0, 0.0))


def futures_at(*positions, size=32):
    """Futures of one frame a candidate, of random pixels, with cameras at world positions."""
    rgb, depth = random_frames(0, frames=len(positions), size=size)
    poses = torch.eye(4, dtype=torch.float64).repeat(len(positions), 1, 1, 1)
    poses[:, 0, :3, 3] = torch.tensor(positions, dtype=torch.float64)
    return Futures(rgb[:, None], depth[:, None], poses, torch.ones(len(positions), 1, dtype=torch.bool))


def image_goal(rgb):
    return Goal(rgb, None, "room")


@pytest.fixture(params=["lpips", "dreamsim", "dino"])
def cost(request, tmp_path, monkeypatch):
    """A cost of images with random weights."""
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path))
    monkeypatch.setattr(dreamsim, "WIDTH", 24)
    cache_random(tmp_path, "lpips-alex", tensor_shapes(ALEX))
    cache_random(tmp_path, "dreamsim", dreamsim.tensor_shapes())
    cache_random_encoder(tmp_path / "weights" / "dinov2-s-derived")
    return make_cost(request.param, {})


def test_only_the_goal_image_itself_costs_nothing(cost):
    futures = futures_at((0, 0, 0), (1, 0, 0), (2, 0, 0))
    costs = cost.measure(futures, image_goal(futures.rgb[1, 0]), GROUND)
    assert costs.shape == (3, 1)
    assert float(costs[1]) == pytest.approx(0, abs=1e-9)
    assert min(costs[0], costs[2]) > 1e-6


def test_a_frame_costs_the_same_in_any_batch_and_for_a_new_goal(cost):
    futures = futures_at((0, 0, 0), (1, 0, 0), (2, 0, 0))
    one = Futures(futures.rgb[2:], futures.depth[2:], futures.world_from_camera[2:], futures.free[2:])
    for number in (0, 1):
        goal = image_goal(futures.rgb[number, 0])
        alone = cost.measure(one, goal, GROUND)
        torch.testing.assert_close(cost.measure(futures, goal, GROUND)[2:], alone, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize(("name", "metric"), [("lpips", "lpips-alex"), ("dreamsim", "dreamsim")])
@pytest.mark.parametrize("cost", ["lpips"], indirect=True)
def test_the_costs_named_as_metrics_are_these_metrics(cost, name, metric):
    futures, (goal, _) = futures_at((0, 0, 0), (1, 0, 0)), random_frames(1, frames=1)
    truth = still_camera(goal.expand(2, -1, -1, -1), futures.depth[:, 0])
    measured = METRICS[metric].measure(prediction(futures.rgb[:, 0], futures.depth[:, 0], truth))
    costs = make_cost(name, {}).measure(futures, image_goal(goal[0]), GROUND)
    torch.testing.assert_close(costs[:, 0], measured, rtol=1e-6, atol=1e-9)


def test_a_goal_image_of_another_size_or_none_is_one_line(cost):
    futures = futures_at((0, 0, 0))
    with pytest.raises(PersistError, match="the goal image has 48×48 pixels, frames have 32×32; resize it"):
        cost.measure(futures, image_goal(random_frames(0, size=48)[0][0]), GROUND)
    with pytest.raises(PersistError, match=f"cost '{cost.name}' compares images, and the goal is a place"):
        cost.measure(futures, Goal(None, torch.zeros(3), "room"), GROUND)


def test_costs_without_weights_say_how_they_are_fetched(tmp_path, monkeypatch):
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path))
    missing = {name: load_plugin("cost", name).missing() for name in ("lpips", "dreamsim", "dino", "distance")}
    assert missing["lpips"].endswith("persist weights fetch lpips-alex")
    assert missing["dreamsim"].endswith("persist weights fetch dreamsim --from DIR")
    assert missing["dino"].endswith("persist weights fetch dinov2-s-derived")
    assert missing["distance"] == ""
    with pytest.raises(PersistError, match=r"cost 'dino': weights .* are not here"):
        make_cost("dino", {}).measure(futures_at((0, 0, 0)), image_goal(random_frames(0)[0][0]), GROUND)


@pytest.mark.parametrize("cost", ["lpips"], indirect=True)
@pytest.mark.parametrize(("height", "width"), [(24, 24), (24, 40), (40, 24)])
def test_images_too_small_for_lpips_are_one_line(cost, height, width):
    futures = futures_at((0, 0, 0), size=40)
    futures = replace(futures, rgb=futures.rgb[:, :, :height, :width])
    with pytest.raises(PersistError, match="LPIPS takes images of at least 31 px, not 24"):
        cost.measure(futures, image_goal(futures.rgb[0, 0]), GROUND)


def test_the_distance_is_measured_on_the_ground_alone():
    futures = futures_at((0, 0, 0), (3, 5, 4))  # y is down here
    goal = Goal(None, torch.tensor([0.0, -1.0, 0.0]), "room")
    cost = make_cost("distance", {})
    assert cost.measure(futures, goal, GROUND).tolist() == [[0.0], [5.0]]
    with pytest.raises(PersistError, match="cost 'distance' measures the way to a place, and the goal is an image"):
        cost.measure(futures, replace(goal, position=None, rgb=futures.rgb[0, 0]), GROUND)


def room_with_wall():
    """Ground of 4 m × 4 m in squares of 0.1 m, with a wall at x = 2 m that leaves the last metre open; y is up."""
    states = torch.full((40, 40), int(Cover.FREE), dtype=torch.uint8)
    states[:30, 20] = int(Cover.OCCUPIED)
    return GroundMap(states, (0.0, 0.0), 0.1, ground_axes((0.0, 0.0, 1.0)))


def test_the_geodesic_cost_leads_round_a_wall_and_counts_unknown_ground_more():
    ground = room_with_wall()
    goal = Goal(None, torch.tensor([3.0, 0.55, 1.2]), "room")
    futures = futures_at((1.0, 0.55, 1.2), (3.0, 1.55, 0.0))
    behind, beside = (
        make_cost("geodesic", {"radius": 0.1, "unknown": 20.0}).measure(futures, goal, ground)[:, 0].tolist()
    )
    assert beside == pytest.approx(1.0, abs=0.1)
    assert behind > 2 * (2.45**2 + 1) ** 0.5  # up to the wall's end and down again, where straight it is 2 m
    unseen = GroundMap(torch.zeros_like(ground.states), ground.origin, ground.spacing, ground.axes)
    over_unknown = make_cost("geodesic", {"unknown": 3.0}).measure(futures, goal, unseen)
    assert over_unknown[:, 0].tolist() == pytest.approx([6.0, 3.0], abs=0.3)


def test_the_geodesic_cost_to_one_goal_is_not_taken_for_that_to_another_or_on_another_map():
    goals = [Goal(None, torch.tensor([x, 0.55, 1.2]), "room") for x in (3.0, 1.5)]
    ground = room_with_wall()
    open_ground = replace(ground, states=torch.full_like(ground.states, int(Cover.FREE)))
    near, far, cost = futures_at((1.0, 0.55, 1.2)), futures_at((9.0, 0.55, 1.2)), make_cost("geodesic", {})
    for goal, known in ((goals[0], ground), (goals[1], ground), (goals[0], ground), (goals[0], open_ground)):
        for futures in (near, far):
            alone = make_cost("geodesic", {}).measure(futures, goal, known)
            assert cost.measure(futures, goal, known).tolist() == alone.tolist()


def test_the_geodesic_cost_takes_the_radius_of_the_body_unless_it_has_its_own():
    states = torch.full((40, 40), int(Cover.FREE), dtype=torch.uint8)
    states[:18, 20] = states[22:, 20] = int(Cover.OCCUPIED)  # a gap of 0.4 m between walls
    ground = GroundMap(states, (0.0, 0.0), 0.1, ground_axes((0.0, 0.0, 1.0)))
    goal, futures = Goal(None, torch.tensor([3.0, 2.0, 1.2]), "room"), futures_at((1.0, 2.0, 1.2))
    slim, wide = (make_cost("geodesic", {}).of_body(Body(radius)) for radius in (0.1, 0.4))
    assert float(slim.measure(futures, goal, ground)) < 2.2
    assert float(wide.measure(futures, goal, ground)) == math.inf
    kept = make_cost("geodesic", {"radius": 0.1}).of_body(Body(0.4))
    assert float(kept.measure(futures, goal, ground)) < 2.2


def test_the_geodesic_cost_knows_places_off_the_map_and_ways_that_are_shut():
    ground = room_with_wall()
    cost = make_cost("geodesic", {"unknown": 2.0})
    off = cost.measure(futures_at((7.0, 2.0, 0.0)), Goal(None, torch.tensor([3.5, 2.0, 0.0]), "room"), ground)
    assert float(off) == pytest.approx(0.5 + 2 * 3.0, abs=0.3)
    shut = ground.states.clone()
    shut[20:30, 20:30] = int(Cover.OCCUPIED)
    shut[22:28, 22:28] = int(Cover.FREE)
    walls = GroundMap(shut, ground.origin, ground.spacing, ground.axes)
    inside = cost.measure(futures_at((2.5, 2.5, 0.0)), Goal(None, torch.tensor([0.5, 0.5, 0.0]), "room"), walls)
    assert float(inside) == float("inf")


def test_the_listing_of_plugins_says_which_weights_a_cost_lacks(persist, tmp_path, monkeypatch):
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path))
    rows = {row["name"]: row["state"] for row in json.loads(persist("plugins", "--json").out) if row["kind"] == "cost"}
    assert "persist weights fetch lpips-alex" in rows["lpips"]
    assert rows["geodesic"] == rows["distance"] == "ok"
