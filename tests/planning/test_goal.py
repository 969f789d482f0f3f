"""Goals that are places on the command line."""

from types import SimpleNamespace

import pytest
import torch

from persist_cli.api.ground import GroundMap
from persist_cli.api.memory import MapPoints
from persist_cli.planning.goal import check_near, read_goal


def test_two_numbers_are_a_place_on_the_map_at_the_height_of_the_camera_and_three_are_one_in_the_world(model):
    now, info = model.agents[0].now, model.agents[0].info
    ground, goal = GroundMap.empty(info.world_up), read_goal("1.5,-2", now, info)
    assert ground.places(goal.position).tolist() == pytest.approx([1.5, -2.0])
    assert float(ground.axes[2] @ goal.position) == pytest.approx(float(ground.axes[2] @ now.cameras.centers[0]))
    assert read_goal("1.5, -2, 7e-1", now, info).position.tolist() == [1.5, -2.0, 0.7]


def test_a_place_near_to_what_is_remembered_is_near_enough(model):
    now, info = model.agents[0].now, model.agents[0].info
    far = torch.tensor([[60.0, 0.0, 0.0]], dtype=torch.float64)
    memory = SimpleNamespace(points=lambda: MapPoints(far, torch.zeros(1, 3, dtype=torch.uint8)))
    agent, ground = SimpleNamespace(now=now, memory=memory), GroundMap.empty(info.world_up)
    check_near("70,0", read_goal("70,0", now, info), agent, ground)
