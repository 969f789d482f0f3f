"""Which snapshots show which places: seen again by others, or in view of the cameras that ask.

Everything here is measured in images and along rays, so a rigid motion of the whole world changes nothing.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from persist_cli.api.geometry import nearest_at
from persist_memory.snapshots.store import SnapshotStore

Located = tuple[
    Int64[Tensor, "snapshot view patch"], Float[Tensor, "snapshot view patch"], Bool[Tensor, "snapshot view patch"]
]

SAME_PLACE = 0.25  # two depths along a ray agree within a quarter: a patch of oblique floor spans about as much

ROUNDING = 1e-6  # patch centres love to lie on the rim of another grid's cells

MICRO = 1e6  # distances are compared in micrometres, so that ties do not hang on the last bit


def seen_patches(store: SnapshotStore, by: SnapshotStore) -> Bool[Tensor, "snapshot by patch"]:
    """Which patches of ``store`` each snapshot of ``by`` shows at the same depth."""
    rows, columns = store.grid
    cell, depth, inside = locate(store.points, by.world_from_camera, by.intrinsics, by.size, (rows, columns))
    shown = by.depth.double().gather(1, cell.permute(1, 0, 2).flatten(1)).reshape(cell.permute(1, 0, 2).shape)
    shown = shown.permute(1, 0, 2)
    same = (depth - shown).abs() <= SAME_PLACE * shown
    return inside & same & (shown > 0) & (store.depth > 0)[:, None]


def most_redundant(seen: Bool[Tensor, "snapshot by patch"], store: SnapshotStore) -> int:
    """The snapshot of whose patches the greatest share is shown by another one too; the last of equal ones."""
    others = seen & ~torch.eye(len(seen), dtype=torch.bool, device=seen.device)[..., None]
    share = others.any(1).sum(-1) / (store.depth > 0).sum(-1)
    return int((share == share.amax()).nonzero()[-1])


def covered_view(
    store: SnapshotStore, world_from_camera: Tensor, intrinsics: Tensor, size: Int64[Tensor, "view 2"]
) -> Bool[Tensor, "snapshot place"]:
    """Which places in the views each snapshot shows; a place is a cell of a grid over a view's image.

    Of the patches that fall into a place only those not far behind its nearest one count: what a snapshot of the
    next room shows is hidden by the wall.
    """
    rows, columns = store.grid
    cell, depth, inside = locate(store.points, world_from_camera, intrinsics, size, (rows, columns))
    inside = inside & (store.depth > 0)[:, None]
    places = len(world_from_camera) * rows * columns
    offset = torch.arange(len(world_from_camera), device=cell.device)[:, None] * (rows * columns)
    place = torch.where(inside, cell + offset, places)
    nearest = nearest_at(place.flatten(), depth.flatten(), places + 1)
    place = torch.where(depth <= (1 + SAME_PLACE) * nearest[place], place, places)
    covered = torch.zeros(len(store), places + 1, dtype=torch.bool, device=cell.device)
    return covered.scatter_(1, place.flatten(1), True)[:, :places]


def greedy_cover(
    covered: Bool[Tensor, "snapshot place"], distances: Float[Tensor, " snapshot"], count: int
) -> list[int]:
    """At most ``count`` snapshots: each the one that shows most places that those before it do not.

    Among equals the nearest comes first. When all places are shown the cover starts anew with the snapshots that
    are left; those that show no place at all are never taken.
    """
    order = torch.argsort((distances * MICRO).round(), stable=True)
    useful = order[covered.any(1)[order]].tolist()
    missing = torch.ones_like(covered[0]) if len(covered) else covered
    chosen: list[int] = []
    while useful and len(chosen) < count:
        gains = (covered[useful] & missing).sum(-1).tolist()
        if max(gains) == 0:
            missing = torch.ones_like(missing)
            continue
        best = useful.pop(gains.index(max(gains)))
        missing = missing & ~covered[best]
        chosen.append(best)
    return chosen


def locate(
    points: Float[Tensor, "snapshot patch 3"],
    world_from_camera: Float[Tensor, "view 4 4"],
    intrinsics: Float[Tensor, "view 3 3"],
    size: Int64[Tensor, "view 2"],
    grid: tuple[int, int],
) -> tuple[
    Int64[Tensor, "snapshot view patch"], Float[Tensor, "snapshot view patch"], Bool[Tensor, "snapshot view patch"]
]:
    """Where points fall in images: the cell of a grid over the image, the planar depth, whether inside at all."""
    scale = torch.stack([grid[1] / size[:, 1].double(), grid[0] / size[:, 0].double()], dim=-1)[..., None]
    ahead = intrinsics.new_tensor([[[0.0, 0.0, 1.0]]]).expand(len(intrinsics), -1, -1)
    onto = torch.cat([intrinsics[:, :2] * scale, ahead], dim=1) @ world_from_camera[:, :3, :3].mT
    origins = (onto @ world_from_camera[:, :3, 3:])[..., 0]
    places = (onto.transpose(0, 1).flatten(0, 1) @ points.flatten(0, 1).mT).unflatten(0, (3, -1))  # axis, view, point
    column, row, depth = places.sub_(origins.T[..., None]).unbind(0)
    safe = depth.clamp(min=1e-9)
    row, column = (each.div_(safe).add_(ROUNDING).floor_() for each in (row, column))
    inside = (depth > 0) & (row >= 0) & (row < grid[0]) & (column >= 0) & (column < grid[1])
    cell = torch.where(inside, row.mul_(grid[1]).add_(column), 0.0).long()
    cell, depth, inside = (each.unflatten(1, points.shape[:2]).transpose(0, 1) for each in (cell, depth, inside))
    return cell, depth, inside
