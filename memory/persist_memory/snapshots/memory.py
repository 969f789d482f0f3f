"""A memory of images (3D-Mem): the few snapshots that show most of what is in view.

3D-Mem chooses its snapshots by detected objects; this is the form without a detector. Nothing in it depends on
axes or origin of the world.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Bool, Float, Int64
from pydantic import PositiveInt
from torch import Tensor

from persist_cli.api.cameras import Cameras, check_intrinsics, check_poses
from persist_cli.api.encoder import Encoder
from persist_cli.api.memory import FrameOfReference, MapPoints, Memory, MemoryFigures
from persist_cli.api.observations import Observations
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import CheckpointError
from persist_memory.snapshots.cover import covered_view, greedy_cover, most_redundant, seen_patches
from persist_memory.snapshots.store import SnapshotStore
from persist_memory.stored_tensors import (
    check_mergeable,
    check_observations,
    check_tensors,
    distinct_cameras,
    same_size,
)

FRAMES_AT_ONCE = 16

DRAWN = 0.12  # metres across of a drawn patch


@dataclass(frozen=True)
class SnapshotsSettings:
    """How many images are kept and given.

    Args:
        count: images that a reading gives at most.
        capacity: images that are kept at most.
        grid: rows and columns of tokens of an image; the encoder's features are averaged into them.
    """

    count: PositiveInt = 8
    capacity: PositiveInt = 64
    grid: tuple[PositiveInt, PositiveInt] = (8, 8)


class Snapshots(Memory):
    """A bounded album of posed images, read as the tokens of the few that show most of what is in view.

    Writing keeps every frame that has any depth, until there are ``capacity``. Then each new frame drives out the
    one, itself included, of whose patches the greatest share is shown at the same depth by another kept image.
    A frame that is kept already is not kept twice. Up to ``capacity`` frames the order of writing leaves no trace.

    Reading lays the token grid over each asked camera's image. A snapshot shows such a place when one of its patches
    falls into it and lies not far behind the nearest patch there. Snapshots are taken greedily, each the one that
    shows most places not shown yet; see ``greedy_cover``. Their tokens follow snapshot by snapshot and row by row, at
    the patches' points in space; patches without depth give none.
    """

    settings_type = SnapshotsSettings
    settings: SnapshotsSettings

    def __init__(self, settings: SnapshotsSettings, encoder: Encoder, reference: FrameOfReference) -> None:
        super().__init__(settings, encoder, reference)
        self._album: SnapshotStore | None = None
        self._seen: Tensor | None = None  # which patches of one snapshot another shows; made when first full

    @property
    def album(self) -> SnapshotStore:
        """What is kept; made when first wanted, since an encoder may have to open a file to know its channels."""
        if self._album is None:
            self._album = SnapshotStore.empty(self.settings.grid, self.encoder.channels)
        return self._album

    def write(self, observations: Observations) -> None:
        """Keep the frames; one without any valid depth is left out.

        Raises:
            DataError: when a pose is not finite and rigid, and nothing is written.
        """
        check_observations(observations, f"memory {self.name!r}")
        for begin in range(0, len(observations), FRAMES_AT_ONCE):
            part = observations[begin : begin + FRAMES_AT_ONCE]
            features = self.encoder.encode(part.rgb).to(part.depth.device)
            self._keep(SnapshotStore.of(part, features, self.settings.grid))

    def read(self, cameras: Cameras, budget: int) -> MemoryTokens:
        """At most ``budget`` tokens of at most ``count`` snapshots, the one that shows most of the view first."""
        return self.read_batch([cameras], budget)[0]

    def read_batch(self, cameras: Sequence[Cameras], budget: int) -> list[MemoryTokens]:
        """What ``read`` gives each of several askers; what the album shows is found once for all of them."""
        album = self.album
        if not len(album):
            return [MemoryTokens.empty(self.encoder.channels) for _ in cameras]
        cameras = [each.to(album.content.device) for each in cameras]
        if not same_size(cameras):
            return super().read_batch(cameras, budget)
        views, groups = distinct_cameras(cameras)
        size = torch.tensor([[views.height, views.width]], device=album.content.device).expand(len(views), 2)
        covered = covered_view(album, views.world_from_camera.double(), views.intrinsics.double(), size)
        covered = covered.unflatten(1, (len(views), -1))
        pairs = zip(groups, cameras, strict=True)
        return [self._tokens(covered[:, group].flatten(1), each, budget) for group, each in pairs]

    def copy(self) -> Self:
        """Another album of the same snapshots, shared until one of both is written."""
        twin = type(self)(self.settings, self.encoder, self.reference)
        twin._album, twin._seen = self._album, self._seen
        return twin

    def tensors(self) -> dict[str, Tensor]:
        """The album in the order of the images' contents."""
        return self.album.tensors() if len(self.album) else {}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Replace the album by what ``tensors()`` gave.

        Raises:
            CheckpointError: when they are not tensors of this memory; what was kept is still kept.
        """
        album = SnapshotStore.empty(self.settings.grid, self.encoder.channels)
        if tensors:
            where = f"memory {self.name!r}"
            shapes = {name: (tensor.dtype, (None, *tensor.shape[1:])) for name, tensor in album.tensors().items()}
            check_tensors(tensors, shapes, where)
            check_poses(tensors["world_from_camera"].cpu(), where)
            for intrinsics in tensors["intrinsics"]:
                check_intrinsics(intrinsics, where)
            if bool((tensors["size"] < 1).any()):
                raise CheckpointError(f"{where}: an image size below one pixel")
            album = SnapshotStore(self.settings.grid, **tensors)
        self._album, self._seen = album, None

    def merge(self, other: Memory) -> None:
        """Keep the snapshots of another album, one after the other, as if they came as frames."""
        check_mergeable(self, other)
        if isinstance(other, Snapshots):
            self._keep(other.album)

    def points(self) -> MapPoints:
        """All patches that have depth."""
        placed = self.album.depth > 0
        return MapPoints(self.album.points[placed], self.album.colors[placed], DRAWN)

    def figures(self) -> MemoryFigures:
        """How many snapshots, their bytes, and the bounds of their patches."""
        figures = super().figures()
        return MemoryFigures(len(self.album), figures.bytes, figures.bounds)

    def _tokens(self, covered: Bool[Tensor, "snapshot place"], cameras: Cameras, budget: int) -> MemoryTokens:
        """Those of the snapshots that cover most of an asker's places."""
        centers = cameras.centers.double()
        distances = torch.cdist(self.album.world_from_camera[:, :3, 3], centers).amin(1)
        chosen = torch.tensor(greedy_cover(covered, distances, self.settings.count), dtype=torch.int64)
        picked = self.album[chosen.to(centers.device)]
        placed = picked.depth > 0
        return MemoryTokens.of(picked.features[placed][:budget], picked.points[placed][:budget])

    def _keep(self, snapshots: SnapshotStore) -> None:
        """Take in snapshots: at once while there is room, then one by one; how frames were grouped leaves no trace."""
        snapshots = snapshots[(snapshots.depth > 0).any(1)]
        fresh = self._unknown(snapshots).nonzero()[: self.settings.capacity - len(self.album), 0]
        if len(fresh):
            self._album, self._seen = self.album.joined(snapshots[fresh]), None
        if len(self.album) < self.settings.capacity:
            return
        for frame in range(int(fresh[-1]) + 1 if len(fresh) else 0, len(snapshots)):
            new = snapshots[torch.tensor([frame], device=snapshots.content.device)]
            if bool(self._unknown(new)):
                self._replace(new)

    def _unknown(self, snapshots: SnapshotStore) -> Bool[Tensor, " snapshot"]:
        """Which snapshots are neither kept nor stand twice among these, the first of equal ones counting as new."""
        album, device = self.album, snapshots.content.device
        kept = _equal(snapshots, album.content.to(device), album.world_from_camera.to(device)).any(1)
        before = _equal(snapshots, snapshots.content, snapshots.world_from_camera).tril(-1).any(1)
        return ~(kept | before)

    def _replace(self, new: SnapshotStore) -> None:
        """Join a snapshot to a full album and drop the most redundant one."""
        seen = self._seen if self._seen is not None else seen_patches(self.album, self.album)
        joined = self.album.joined(new)
        at = int(torch.searchsorted(self.album.content, new.content.to(self.album.content.device), right=True))
        old = torch.arange(len(joined), device=seen.device) != at
        single = joined[~old]
        grown = seen.new_zeros(len(joined), len(joined), seen.shape[-1])
        grown[old.nonzero(), old.nonzero()[:, 0]] = seen
        grown[at] = seen_patches(single, joined)[0]
        grown[:, at] = seen_patches(joined, single)[:, 0]
        kept = torch.arange(len(joined), device=seen.device) != most_redundant(grown, joined)
        self._album, self._seen = joined[kept], grown[kept][:, kept]


def _equal(
    snapshots: SnapshotStore, content: Int64[Tensor, " other"], poses: Float[Tensor, "other 4 4"]
) -> Bool[Tensor, "snapshot other"]:
    """Which snapshots are the same images, taken from the same place, as others."""
    same = (snapshots.world_from_camera[:, None] == poses).flatten(2).all(-1)
    return same & (snapshots.content[:, None] == content)
