"""A bounded album of snapshots of one origin, from which the most redundant ones are dropped."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from persist_memory.snapshots.cover import most_redundant, seen_patches
from persist_memory.snapshots.snapshot_store import SnapshotStore


class Album:
    """At most ``capacity`` snapshots. Adding to a copy does not change the album, although the two share tensors.

    Args:
        store: the snapshots that it holds at first.
        capacity: the greatest number of snapshots.
    """

    def __init__(self, store: SnapshotStore, capacity: int) -> None:
        self.store, self.capacity = store, capacity
        self._seen: Tensor | None = None  # seen_patches(store, store), computed when the album is first full

    def __len__(self) -> int:
        return len(self.store)

    def copy(self) -> Album:
        """An album of the same snapshots."""
        copy = Album(self.store, self.capacity)
        copy._seen = self._seen
        return copy

    def replace(self, store: SnapshotStore) -> None:
        """Hold other snapshots instead."""
        self.store, self._seen = store, None

    def add(self, snapshots: SnapshotStore) -> None:
        """Add snapshots: at once while there is room, then one by one, so that grouping of frames changes no bit."""
        snapshots = snapshots[(snapshots.depth > 0).any(1)]
        fresh = self._is_new(snapshots).nonzero()[: self.capacity - len(self), 0]
        if len(fresh):
            self.replace(self.store.joined(snapshots[fresh]))
        if len(self) < self.capacity:
            return
        for number in range(int(fresh[-1]) + 1 if len(fresh) else 0, len(snapshots)):
            snapshot = snapshots[torch.tensor([number], device=snapshots.content.device)]
            if bool(self._is_new(snapshot)):
                self._replace_most_redundant(snapshot)

    def _is_new(self, snapshots: SnapshotStore) -> Bool[Tensor, " snapshot"]:
        """Whether each snapshot is neither in the album nor equal to one before it."""
        store, device = self.store, snapshots.content.device
        stored = _equal(snapshots, store.content.to(device), store.world_from_camera.to(device)).any(1)
        repeated = _equal(snapshots, snapshots.content, snapshots.world_from_camera).tril(-1).any(1)
        return ~(stored | repeated)

    def _replace_most_redundant(self, new: SnapshotStore) -> None:
        """Add a snapshot to a full album and drop the most redundant one, updating ``_seen`` instead of recomputing."""
        seen = self._seen if self._seen is not None else seen_patches(self.store, self.store)
        joined = self.store.joined(new)
        position = int(torch.searchsorted(self.store.content, new.content.to(self.store.content.device), right=True))
        numbers = torch.arange(len(joined), device=seen.device)
        old = (numbers != position).nonzero()
        single = joined[numbers == position]
        joined_seen = seen.new_zeros(len(joined), len(joined), seen.shape[-1])
        joined_seen[old, old[:, 0]] = seen
        joined_seen[position] = seen_patches(single, joined)[0]
        joined_seen[:, position] = seen_patches(joined, single)[:, 0]
        remaining = numbers != most_redundant(joined_seen, joined)
        self.store, self._seen = joined[remaining], joined_seen[remaining][:, remaining]


def _equal(
    snapshots: SnapshotStore, content: Int64[Tensor, " other"], poses: Float[Tensor, "other 4 4"]
) -> Bool[Tensor, "snapshot other"]:
    """Whether each snapshot has the content and the pose of each other image."""
    same_pose = (snapshots.world_from_camera[:, None] == poses).flatten(2).all(-1)
    return same_pose & (snapshots.content[:, None] == content)
