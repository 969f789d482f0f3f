"""Cameras of viser as those of persist; both have OpenCV axes."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import viser
import viser.transforms as vtf
from torch import Tensor

from persist_cli.api.cameras import Cameras

Array = np.ndarray[Any, Any]


def pose_of(pose: Tensor) -> tuple[Array, Array]:
    """Return a pose ``[4, 4]`` as the quaternion (w, x, y, z) and the position that viser takes."""
    matrix = pose.double().cpu().numpy()
    return vtf.SO3.from_matrix(matrix[:3, :3]).wxyz, matrix[:3, 3]


def world_from(wxyz: Array, position: Array) -> Tensor:
    """Return viser's quaternion (w, x, y, z) and position as a pose ``[4, 4]``, float64."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.from_numpy(vtf.SO3(np.asarray(wxyz, np.float64)).as_matrix())
    pose[:3, 3] = torch.from_numpy(np.asarray(position, np.float64))
    return pose


def camera_of_view(client: viser.ClientHandle, height: int = 64) -> Cameras:
    """Return the camera of a tab's view, ``height`` pixels high, with a frame axis of one."""
    view = client.camera
    width = max(1, round(height * view.aspect))
    focal = height / 2 / float(np.tan(view.fov / 2))
    matrix = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
    return Cameras(world_from(view.wxyz, view.position)[None], matrix[None], height, width)
