"""Choice of snapshots: the most redundant one of an album, and the few that cover most of a view.

Everything here is measured in images and along rays, so a rigid motion of the whole world changes nothing.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from persist_cli.api.geometry import nearest_at
from persist_memory.snapshots.snapshot_store import SnapshotStore

SAME_PLACE = 0.25  # two depths along a ray agree within a quarter: a patch of oblique floor spans about as much

ROUNDING = 1e-6  # of a cell; patch centres often lie on the boundary between two cells of another grid

MICROMETRES = 1e6  # per metre; distances are compared in micrometres, so that ties do not depend on the last bit


def seen_patches(store: SnapshotStore, viewers: SnapshotStore) -> Bool[Tensor, "snapshot viewer patch"]:
    """Whether each patch of ``store`` is shown at the same depth by each snapshot of ``viewers``."""
    cell, depth, inside = locate(store.points, viewers.world_from_camera, viewers.intrinsics, viewers.size, store.grid)
    by_viewer = cell.transpose(0, 1)
    shown = viewers.depth.double().gather(1, by_viewer.flatten(1)).reshape(by_viewer.shape).transpose(0, 1)
    same = (depth - shown).abs() <= SAME_PLACE * shown
    return inside & same & (shown > 0) & (store.depth > 0)[:, None]


def without_observed(imagined: SnapshotStore, observed: SnapshotStore) -> SnapshotStore:
    """Imagined snapshots without the depth of patches that are known already, those without any left are dropped.

    A patch is known when an observed snapshot shows it at the same depth, or when an observed patch falls into it,
    however deep: generated depth is often too small, and such a patch would hide what is behind it.
    """
    if not len(observed) or not len(imagined):
        return imagined
    observed = observed.to(imagined.content.device)
    cell, _, inside = locate(
        observed.points, imagined.world_from_camera, imagined.intrinsics, imagined.size, imagined.grid
    )
    inside = (inside & (observed.depth > 0)[:, None]).transpose(0, 1).flatten(1)
    cells = torch.where(inside, cell.transpose(0, 1).flatten(1), imagined.depth.shape[1])
    known = torch.zeros(len(imagined), imagined.depth.shape[1] + 1, dtype=torch.bool, device=cells.device)
    known = known.scatter_(1, cells, True)[:, :-1] | seen_patches(imagined, observed).any(1)
    rest = replace(imagined, depth=torch.where(known, 0.0, imagined.depth))
    return rest[(rest.depth > 0).any(1)]


def most_redundant(seen: Bool[Tensor, "snapshot viewer patch"], store: SnapshotStore) -> int:
    """The snapshot with the greatest share of patches that another one shows too; the last of equal ones.

    Args:
        seen: ``seen_patches(store, store)``.
        store: the snapshots.
    """
    by_others = seen & ~torch.eye(len(seen), dtype=torch.bool, device=seen.device)[..., None]
    share = by_others.any(1).sum(-1) / (store.depth > 0).sum(-1)
    return int((share == share.amax()).nonzero()[-1])


def covered_view(
    store: SnapshotStore, world_from_camera: Tensor, intrinsics: Tensor, size: Int64[Tensor, "view 2"]
) -> Bool[Tensor, "snapshot place"]:
    """Whether each snapshot shows each place in the views; a place is a cell of the token grid over a view's image.

    Of the patches that fall into a place only those not far behind its nearest one count: what a snapshot of the
    next room shows is hidden by the wall.

    Args:
        store: the snapshots.
        world_from_camera: poses of the views, float64.
        intrinsics: intrinsics of the views, float64.
        size: height and width of each view in pixels.
    """
    rows, columns = store.grid
    cell, depth, inside = locate(store.points, world_from_camera, intrinsics, size, store.grid)
    inside = inside & (store.depth > 0)[:, None]
    places = len(world_from_camera) * rows * columns
    offset = torch.arange(len(world_from_camera), device=cell.device)[:, None] * (rows * columns)
    place = torch.where(inside, cell + offset, places)
    nearest = nearest_at(place.flatten(), depth.flatten(), places + 1)
    place = torch.where(depth <= (1 + SAME_PLACE) * nearest[place], place, places)
    covered = torch.zeros(len(store), places + 1, dtype=torch.bool, device=cell.device)
    return covered.scatter_(1, place.flatten(1), True)[:, :places]


def nearest_distances(
    places: Float[Tensor, "snapshot 3"], centers: Float[Tensor, "view 3"]
) -> Float[Tensor, " snapshot"]:
    """Metres from each place to the nearest of some camera centres, exact at any distance from the world's origin."""
    return torch.cdist(places, centers.double(), compute_mode="donot_use_mm_for_euclid_dist").amin(1)


def greedy_cover(
    covered: Bool[Tensor, "snapshot place"], distances: Float[Tensor, " snapshot"], count: int
) -> list[int]:
    """At most ``count`` snapshots, each the one that shows most places that the snapshots before it do not.

    Of equally good ones the nearest comes first. When no remaining snapshot shows a new place, the cover starts anew
    with the remaining ones; those that show no place at all are never chosen.

    Args:
        covered: whether each snapshot shows each place.
        distances: metres from each snapshot to the cameras.
        count: the greatest number of snapshots.
    """
    order = torch.argsort((distances * MICROMETRES).round(), stable=True)
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
    """Project points into views: the cell of a grid over the image, the planar depth, whether it is in the image.

    One matrix product of all views with all points gives coordinates in cells, since this projection is most of the
    time of a read. ``api.geometry.project`` takes three times as long, and its depth has other last bits.
    """
    rows, columns = grid
    scale = torch.stack([columns / size[:, 1].double(), rows / size[:, 0].double()], dim=-1)[..., None]
    forward = intrinsics.new_tensor([[[0.0, 0.0, 1.0]]]).expand(len(intrinsics), -1, -1)
    cells_from_world = torch.cat([intrinsics[:, :2] * scale, forward], dim=1) @ world_from_camera[:, :3, :3].mT
    origins = (cells_from_world @ world_from_camera[:, :3, 3:])[..., 0]
    by_axis = cells_from_world.transpose(0, 1).flatten(0, 1) @ points.flatten(0, 1).mT
    by_axis = by_axis.unflatten(0, (3, -1)).sub_(origins.T[..., None])  # axis, view, point
    column, row, depth = by_axis.unbind(0)
    safe_depth = depth.clamp(min=1e-9)
    column = column.div_(safe_depth).add_(ROUNDING).floor_()
    row = row.div_(safe_depth).add_(ROUNDING).floor_()
    inside = (depth > 0) & (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    cell = torch.where(inside, row.mul_(columns).add_(column), 0.0).long()
    cell, depth, inside = (values.unflatten(1, points.shape[:2]).transpose(0, 1) for values in (cell, depth, inside))
    return cell, depth, inside
