"""A memory of images after 3D-Mem: it gives the few snapshots that show most of what is in view.

3D-Mem chooses its snapshots by detected objects; this one needs no detector. Nothing in it depends on the axes or the
origin of the world.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import torch
from jaxtyping import Bool, UInt8
from pydantic import PositiveInt
from torch import Tensor

from persist_cli.api.cameras import Cameras, check_intrinsics, check_poses
from persist_cli.api.encoder import Encoder
from persist_cli.api.memory import FrameOfReference, MapPoints, Memory, MemoryFigures
from persist_cli.api.observations import Observations, Origin, check_observations, origins_like
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import CheckpointError
from persist_memory.batched_reads import distinct_cameras, same_size
from persist_memory.detail import feature_across, pixels_across
from persist_memory.snapshots.album import Album
from persist_memory.snapshots.cover import covered_view, greedy_cover, nearest_distances, without_observed
from persist_memory.snapshots.snapshot_store import SnapshotStore
from persist_memory.validation import (
    ORIGINS,
    check_mergeable,
    check_origins,
    check_tensors,
    with_origins,
)

FRAMES_AT_ONCE = 16  # encoded and written

PATCH_SPREAD = 0.12  # metres across of a drawn patch


@dataclass(frozen=True)
class SnapshotsSettings:
    """How many images are stored and read.

    Args:
        count: the greatest number of images whose tokens one read gives.
        capacity: the greatest number of observed images that are stored, and of imagined ones.
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

    Imagined frames have an album of their own, with room for ``capacity`` more, so they change no bit of the observed
    images. Patches of imagined images that observed ones show too lose their depth, whichever comes first; an image
    without any is dropped. See ``without_observed``.

    Reading lays the token grid over the image of each camera. A snapshot shows a place, a cell of that grid, when one
    of its patches falls into it and lies not far behind the nearest patch there. Snapshots are chosen greedily, each
    the one that shows most places not shown yet; see ``greedy_cover``. Their tokens follow snapshot by snapshot and
    row by row, at the patches' points in space; patches without depth give none.
    """

    settings_type = SnapshotsSettings
    settings: SnapshotsSettings

    def __init__(self, settings: SnapshotsSettings, encoder: Encoder, reference: FrameOfReference) -> None:
        super().__init__(settings, encoder, reference)
        self._albums: dict[Origin, Album] = {}

    @property
    def albums(self) -> dict[Origin, Album]:
        """An album of each origin; created on first use, since an encoder may have to open a file for its channels."""
        if not self._albums:
            empty = SnapshotStore.empty(self.settings.grid, self.encoder.channels)
            self._albums = {origin: Album(empty, self.settings.capacity) for origin in reversed(Origin)}
        return self._albums

    @property
    def store(self) -> SnapshotStore:
        """All stored images, the observed ones first."""
        observed, imagined = (self.albums[origin].store for origin in (Origin.OBSERVED, Origin.IMAGINED))
        return observed.followed_by(imagined) if len(imagined) else observed

    def write(self, observations: Observations) -> None:
        """Store the frames; one without any valid depth is left out.

        Raises:
            DataError: when a pose is not finite and rigid; then nothing is written.
        """
        check_observations(observations, f"memory {self.name!r}")
        for origin, frames in observations.by_origin():
            for begin in range(0, len(frames), FRAMES_AT_ONCE):
                part = frames[begin : begin + FRAMES_AT_ONCE]
                features = self.encoder.encoded(part.rgb).to(part.depth.device)
                self._add(SnapshotStore.of(part, features, self.settings.grid), origin)

    def read(self, cameras: Cameras, budget: int) -> MemoryTokens:
        """Return at most ``budget`` tokens of at most ``count`` snapshots, best first: it shows most of the view."""
        return self.read_batch([cameras], budget)[0]

    def read_batch(self, cameras: Sequence[Cameras], budget: int) -> list[MemoryTokens]:
        """Return for each camera path what ``read`` gives it; the album is projected once for all of them."""
        store = self.store
        if not len(store):
            return [MemoryTokens.empty(self.encoder.channels) for _ in cameras]
        device = store.content.device
        paths = [path.to(device) for path in cameras]
        if not same_size(paths):
            return super().read_batch(paths, budget)
        views, groups = distinct_cameras(paths)
        size = torch.tensor([[views.height, views.width]], device=device).expand(len(views), 2)
        covered = covered_view(store, views.world_from_camera.double(), views.intrinsics.double(), size)
        by_view = covered.unflatten(1, (len(views), -1))
        pairs = zip(groups, paths, strict=True)
        return [self._tokens(store, by_view[:, group].flatten(1), path, budget) for group, path in pairs]

    def copy(self) -> Self:
        """Return an album of the same snapshots; the two share their tensors until one of them is written."""
        copy = type(self)(self.settings, self.encoder, self.reference)
        copy._albums = {origin: album.copy() for origin, album in self._albums.items()}
        return copy

    def tensors(self) -> dict[str, Tensor]:
        """Return the images and their origins, the observed ones first, each sorted by the hashes of the images."""
        store = self.store
        return store.tensors() | {ORIGINS: self._origins(store)} if len(store) else {}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Replace the images by what ``tensors()`` gave.

        Raises:
            CheckpointError: when they are not tensors of this memory; then the images stay as they were.
        """
        empty = SnapshotStore.empty(self.settings.grid, self.encoder.channels)
        albums = {origin: Album(empty, self.settings.capacity) for origin in reversed(Origin)}
        if tensors:
            tensors = with_origins(tensors)
            self._check(tensors, empty)
            store = SnapshotStore(empty.grid, **{name: tensors[name] for name in empty.tensors()})
            for origin, album in albums.items():
                album.replace(store[tensors[ORIGINS] == origin])
        self._albums = albums

    def merge(self, other: Memory) -> None:
        """Add the snapshots of another memory, one after the other, as if they were written as frames."""
        check_mergeable(self, other)
        if isinstance(other, Snapshots):
            for origin, album in other.albums.items():
                self._add(album.store, origin)

    def points(self) -> MapPoints:
        """Return all patches that have depth."""
        store = self.store
        placed = store.depth > 0
        shown = self._origins(store)[:, None].expand_as(placed)[placed]
        return MapPoints(store.points[placed], store.colors[placed], PATCH_SPREAD, shown)

    def figures(self) -> MemoryFigures:
        """Return the number of images, their bytes, the bounds of their patches, and how many were imagined."""
        return replace(super().figures(), imagined=len(self.albums[Origin.IMAGINED]))

    def resolution(self, cameras: Cameras, distance: float = 2.5) -> float:
        """Return the edge of a patch, or of what one feature of the encoder shows where this is more."""
        patch = pixels_across(cameras.width / self.settings.grid[1], cameras, distance)
        return max(patch, feature_across(self.encoder, cameras, distance))

    def _check(self, tensors: dict[str, Tensor], empty: SnapshotStore) -> None:
        where = f"memory {self.name!r}"
        expected = empty.tensors() | {ORIGINS: origins_like(empty.content, Origin.OBSERVED)}
        check_tensors(tensors, {name: (part.dtype, (None, *part.shape[1:])) for name, part in expected.items()}, where)
        check_origins(tensors, where)
        check_poses(tensors["world_from_camera"].cpu(), where)
        for intrinsics in tensors["intrinsics"]:
            check_intrinsics(intrinsics, where)
        if bool((tensors["size"] < 1).any()):
            raise CheckpointError(f"{where}: an image size below one pixel")

    def _tokens(
        self, store: SnapshotStore, covered: Bool[Tensor, "snapshot place"], cameras: Cameras, budget: int
    ) -> MemoryTokens:
        """Tokens of the snapshots that cover most places in view of the cameras."""
        distances = nearest_distances(store.world_from_camera[:, :3, 3], cameras.centers)
        numbers = torch.tensor(greedy_cover(covered, distances, self.settings.count), dtype=torch.int64)
        chosen = store[numbers.to(cameras.centers.device)]
        placed = chosen.depth > 0
        origins = self._origins(store)[numbers.to(cameras.centers.device)][:, None].expand_as(placed)
        parts = (chosen.features, chosen.points, chosen.colors, origins, chosen.depth)
        return MemoryTokens.of(*(part[placed][:budget] for part in parts))

    def _origins(self, store: SnapshotStore) -> UInt8[Tensor, " snapshot"]:
        """The origin of each image of ``self.store``."""
        origins = origins_like(store.content, Origin.IMAGINED)
        origins[: len(self.albums[Origin.OBSERVED])] = Origin.OBSERVED
        return origins

    def _add(self, snapshots: SnapshotStore, origin: Origin) -> None:
        """Add snapshots of one origin, and hide what is imagined behind what is observed."""
        observed, imagined = self.albums[Origin.OBSERVED], self.albums[Origin.IMAGINED]
        if origin == Origin.OBSERVED:
            observed.add(snapshots)
            if len(imagined):
                imagined.replace(without_observed(imagined.store, observed.store))
        else:
            imagined.add(without_observed(snapshots, observed.store))
