"""A memory of images after 3D-Mem: it gives the few snapshots that show most of what is in view.

3D-Mem chooses its snapshots by detected objects; this one needs no detector. Nothing in it depends on the axes or the
origin of the world.
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
from persist_cli.api.memory import FrameOfReference, MapPoints, Memory
from persist_cli.api.observations import Observations
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import CheckpointError
from persist_memory.batched_reads import distinct_cameras, same_size
from persist_memory.snapshots.cover import covered_view, greedy_cover, most_redundant, seen_patches
from persist_memory.snapshots.snapshot_store import SnapshotStore
from persist_memory.validation import check_mergeable, check_observations, check_tensors

FRAMES_AT_ONCE = 16  # encoded and written

PATCH_SPREAD = 0.12  # metres across of a drawn patch


@dataclass(frozen=True)
class SnapshotsSettings:
    """How many images are stored and read.

    Args:
        count: the greatest number of images whose tokens one read gives.
        capacity: the greatest number of images that are stored.
        grid: rows and columns of an image's tokens; the encoder's features are averaged into them.
    """

    count: PositiveInt = 8
    capacity: PositiveInt = 64
    grid: tuple[PositiveInt, PositiveInt] = (8, 8)


class Snapshots(Memory):
    """A bounded album of posed images, read as the tokens of the few that show most of what is in view.

    Writing stores every frame that has any depth, until there are ``capacity``. From then on each new frame joins the
    album and the most redundant image leaves it: the one with the greatest share of patches that another image shows
    at the same depth. This may be the new frame itself. A frame that is stored already is not stored twice. Up to
    ``capacity`` frames the order of writing changes no bit.

    Reading lays the token grid over the image of each camera. A snapshot shows a place, a cell of that grid, when one
    of its patches falls into it and lies not far behind the nearest patch there. Snapshots are chosen greedily, each
    the one that shows most places not shown yet; see ``greedy_cover``. Their tokens follow snapshot by snapshot and
    row by row, at the patches' points in space; patches without depth give none.
    """

    settings_type = SnapshotsSettings
    settings: SnapshotsSettings

    def __init__(self, settings: SnapshotsSettings, encoder: Encoder, reference: FrameOfReference) -> None:
        super().__init__(settings, encoder, reference)
        self._album: SnapshotStore | None = None
        self._seen: Tensor | None = None  # seen_patches(album, album), computed when the album is first full

    @property
    def album(self) -> SnapshotStore:
        """The stored images; created on first use, since an encoder may have to open a file to know its channels."""
        if self._album is None:
            self._album = SnapshotStore.empty(self.settings.grid, self.encoder.channels)
        return self._album

    def write(self, observations: Observations) -> None:
        """Store the frames; one without any valid depth is left out.

        Raises:
            DataError: when a pose is not finite and rigid; then nothing is written.
        """
        check_observations(observations, f"memory {self.name!r}")
        for begin in range(0, len(observations), FRAMES_AT_ONCE):
            part = observations[begin : begin + FRAMES_AT_ONCE]
            features = self.encoder.encode(part.rgb).to(part.depth.device)
            self._add(SnapshotStore.of(part, features, self.settings.grid))

    def read(self, cameras: Cameras, budget: int) -> MemoryTokens:
        """Return at most ``budget`` tokens of at most ``count`` snapshots, best first: it shows most of the view."""
        return self.read_batch([cameras], budget)[0]

    def read_batch(self, cameras: Sequence[Cameras], budget: int) -> list[MemoryTokens]:
        """Return for each camera path what ``read`` gives it; the album is projected once for all of them."""
        album = self.album
        if not len(album):
            return [MemoryTokens.empty(self.encoder.channels) for _ in cameras]
        device = album.content.device
        paths = [path.to(device) for path in cameras]
        if not same_size(paths):
            return super().read_batch(paths, budget)
        views, groups = distinct_cameras(paths)
        size = torch.tensor([[views.height, views.width]], device=device).expand(len(views), 2)
        covered = covered_view(album, views.world_from_camera.double(), views.intrinsics.double(), size)
        by_view = covered.unflatten(1, (len(views), -1))
        pairs = zip(groups, paths, strict=True)
        return [self._tokens(by_view[:, group].flatten(1), path, budget) for group, path in pairs]

    def copy(self) -> Self:
        """Return an album of the same snapshots; the two share their tensors until one of them is written."""
        copy = type(self)(self.settings, self.encoder, self.reference)
        copy._album, copy._seen = self._album, self._seen
        return copy

    def tensors(self) -> dict[str, Tensor]:
        """Return the album, sorted by the hashes of the images."""
        return self.album.tensors() if len(self.album) else {}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Replace the album by what ``tensors()`` gave.

        Raises:
            CheckpointError: when they are not tensors of this memory; then the album stays as it was.
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
        """Add the snapshots of another album, one after the other, as if they were written as frames."""
        check_mergeable(self, other)
        if isinstance(other, Snapshots):
            self._add(other.album)

    def points(self) -> MapPoints:
        """Return all patches that have depth."""
        placed = self.album.depth > 0
        return MapPoints(self.album.points[placed], self.album.colors[placed], PATCH_SPREAD)

    def _tokens(self, covered: Bool[Tensor, "snapshot place"], cameras: Cameras, budget: int) -> MemoryTokens:
        """Tokens of the snapshots that cover most places in view of the cameras."""
        centers = cameras.centers.double()
        distances = torch.cdist(self.album.world_from_camera[:, :3, 3], centers).amin(1)
        numbers = torch.tensor(greedy_cover(covered, distances, self.settings.count), dtype=torch.int64)
        chosen = self.album[numbers.to(centers.device)]
        placed = chosen.depth > 0
        return MemoryTokens.of(chosen.features[placed][:budget], chosen.points[placed][:budget])

    def _add(self, snapshots: SnapshotStore) -> None:
        """Add snapshots: at once while there is room, then one by one, so that grouping of frames changes no bit."""
        snapshots = snapshots[(snapshots.depth > 0).any(1)]
        fresh = self._is_new(snapshots).nonzero()[: self.settings.capacity - len(self.album), 0]
        if len(fresh):
            self._album, self._seen = self.album.joined(snapshots[fresh]), None
        if len(self.album) < self.settings.capacity:
            return
        for number in range(int(fresh[-1]) + 1 if len(fresh) else 0, len(snapshots)):
            snapshot = snapshots[torch.tensor([number], device=snapshots.content.device)]
            if bool(self._is_new(snapshot)):
                self._replace_most_redundant(snapshot)

    def _is_new(self, snapshots: SnapshotStore) -> Bool[Tensor, " snapshot"]:
        """Whether each snapshot is neither in the album nor equal to one before it."""
        album, device = self.album, snapshots.content.device
        stored = _equal(snapshots, album.content.to(device), album.world_from_camera.to(device)).any(1)
        repeated = _equal(snapshots, snapshots.content, snapshots.world_from_camera).tril(-1).any(1)
        return ~(stored | repeated)

    def _replace_most_redundant(self, new: SnapshotStore) -> None:
        """Add a snapshot to a full album and drop the most redundant one, updating ``_seen`` instead of recomputing."""
        seen = self._seen if self._seen is not None else seen_patches(self.album, self.album)
        joined = self.album.joined(new)
        position = int(torch.searchsorted(self.album.content, new.content.to(self.album.content.device), right=True))
        numbers = torch.arange(len(joined), device=seen.device)
        old = (numbers != position).nonzero()
        single = joined[numbers == position]
        joined_seen = seen.new_zeros(len(joined), len(joined), seen.shape[-1])
        joined_seen[old, old[:, 0]] = seen
        joined_seen[position] = seen_patches(single, joined)[0]
        joined_seen[:, position] = seen_patches(joined, single)[:, 0]
        remaining = numbers != most_redundant(joined_seen, joined)
        self._album, self._seen = joined[remaining], joined_seen[remaining][:, remaining]


def _equal(
    snapshots: SnapshotStore, content: Int64[Tensor, " other"], poses: Float[Tensor, "other 4 4"]
) -> Bool[Tensor, "snapshot other"]:
    """Whether each snapshot has the content and the pose of each other image."""
    same_pose = (snapshots.world_from_camera[:, None] == poses).flatten(2).all(-1)
    return same_pose & (snapshots.content[:, None] == content)
