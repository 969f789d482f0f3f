"""Where the surfaces of a frame lie, and which cells it frees before them."""

import pytest
import torch

from persist_cli.api.cameras import Cameras
from persist_cli.api.geometry import camera_rays
from persist_cli.api.observations import Observations
from persist_memory.scene.fusion import UNDER, surface_normals, votes_of

SIZE = 0.25


def camera(side: int) -> Cameras:
    """A camera of 90 degrees at the origin that looks along z."""
    lens = torch.tensor([[side / 2, 0, side / 2], [0, side / 2, side / 2], [0, 0, 1]], dtype=torch.float64)
    return Cameras(torch.eye(4, dtype=torch.float64)[None], lens[None], side, side)


def test_the_rim_of_a_thing_before_a_wall_faces_where_the_thing_faces():
    depth = torch.full((1, 8, 8), 3.0, dtype=torch.float64)
    depth[:, 2:6, 2:6] = 1.0
    points = camera_rays(camera(8)) * depth[..., None]
    normals = surface_normals(points, depth > 0)
    assert torch.allclose(normals, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(normals))


@pytest.mark.parametrize("away", [(0.0, 0.9, 0.2), (0.5, 0.3, 0.8), (-0.6, 0.7, 0.1)])
def test_a_cell_whose_middle_is_nearly_at_a_slanted_surface_is_not_freed(away):
    normal = torch.nn.functional.normalize(torch.tensor(away, dtype=torch.float64), dim=0)
    cameras, far = camera(16), 1.29  # metres of the surface's plane from the camera
    depth = far / (camera_rays(cameras) @ normal)
    depth = torch.where((depth > 0) & (depth < 6), depth, 0.0)
    frame = Observations(torch.zeros(1, 16, 16, 3, dtype=torch.uint8), depth.float(), cameras)
    [votes] = votes_of(frame, torch.eye(3, dtype=torch.float64), SIZE, 5.0)
    before = far - (votes.passed * SIZE).double() @ normal
    assert len(before) > 40
    assert float(before.min()) > UNDER * SIZE - 1e-5
