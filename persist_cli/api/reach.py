"""What an agent reaches: things right ahead that it can pick up or toggle, and the cells that may change by that."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor

from persist_cli.api.cells import CellGrid

REACH = 1.5  # metres to a thing that can be picked up or toggled: nearer ones are below the image
AHEAD = 0.8  # of the distance to a thing that must lie along the heading
CHANGED = 2.25  # metres on the ground within which cells change by an interaction: reach and the thing's own size


def place_and_heading(
    world_from_camera: Float[Tensor, "4 4"], axes: Float[Tensor, "3 3"]
) -> tuple[Float[Tensor, " 2"], Float[Tensor, " 2"]]:
    """Return a camera's place on the ground axes in metres, and the unit vector there along which it looks."""
    axes = axes.to(world_from_camera.device)
    place, ahead = ((axes @ world_from_camera[:3, column].double())[:2] for column in (3, 2))
    return place, ahead / ahead.norm().clamp_min(1e-9)


def cells_in_reach(grid: CellGrid, world_from_camera: Float[Tensor, "4 4"]) -> Bool[Tensor, "first second level"]:
    """Return the cells that an interaction can change: those at most ``CHANGED`` metres ahead, at all heights.

    Args:
        grid: the cells.
        world_from_camera: pose of the agent's camera.
    """
    place, ahead = place_and_heading(world_from_camera, grid.axes)
    offset = grid.columns() - place.to(grid.classes.device)
    near: Tensor = (offset.norm(dim=-1) <= CHANGED) & ((offset @ ahead.to(offset.device)) > 0)
    return near[..., None].expand(grid.shape)
