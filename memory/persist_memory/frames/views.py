"""Posed images chosen by how much of the view they may show: 3D-Mem's snapshots without lifting by depth.

Without depth nobody knows what an image shows behind which surface. As in Context as Memory (2506.03141) fields of view
are compared instead: points are spread over the view at several distances, and an image covers those that lie in its
own field of view.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from pydantic import PositiveInt
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.geometry import unproject
from persist_cli.api.memory import Memory
from persist_cli.api.observations import Origin
from persist_memory.frames.frame_memory import FrameMemory, FrameSettings, FrameStore, frame_stores
from persist_memory.snapshots.cover import greedy_cover, locate, nearest_distances
from persist_memory.validation import check_mergeable

POINTS = 4  # along each side of an image
DISTANCES = (0.5, 1.0, 2.0, 4.0)  # metres, of the points in the view


@dataclass(frozen=True)
class ViewsSettings(FrameSettings):
    """How many images are stored and read.

    Args:
        capacity: the greatest number of observed images that are stored, and of imagined ones.
    """

    capacity: PositiveInt = 64


class ViewsMemory(FrameMemory):
    """A bounded album of posed images without depth, read as the few whose fields of view cover most of the view.

    When there are more than ``capacity`` images of one origin, the most redundant of them leave: those whose own view
    lies in the fields of view of most others. Imagined images never push out observed ones.
    """

    settings_type = ViewsSettings
    settings: ViewsSettings

    def kept(self, store: FrameStore) -> FrameStore:
        """Return the images without the most redundant ones of an origin that has too many."""
        left = torch.ones_like(store.origins, dtype=torch.bool)
        for origin in Origin:
            among = (store.origins == origin).nonzero()[:, 0]
            if len(among) > self.settings.capacity:
                left[among[_redundant(store.cameras[among], len(among) - self.settings.capacity)]] = False
        return store if bool(left.all()) else store[left.nonzero()[:, 0]]

    def choose(self, store: FrameStore, cameras: Cameras, count: int) -> Int64[Tensor, " chosen"]:
        """Return the images that together cover most of the view, the nearest of equally good ones first."""
        covered = in_field_of_view(view_points(cameras).flatten(0, 1), store.cameras)
        distances = nearest_distances(store.cameras.centers, cameras.centers)
        return torch.tensor(greedy_cover(covered, distances, count), dtype=torch.int64, device=covered.device)

    def merge(self, other: Memory) -> None:
        """Add the images of another memory as if they were written after those of this one."""
        check_mergeable(self, other)
        for store in frame_stores([other]):
            self._add(store)


def view_points(cameras: Cameras) -> Float[Tensor, "view point 3"]:
    """Return points that are spread over each camera's view, at several distances, in world metres."""
    coarse = cameras.resized(POINTS, POINTS)
    depth = torch.ones(len(cameras), POINTS, POINTS, device=cameras.world_from_camera.device)
    return torch.cat([unproject(depth * metres, coarse).flatten(1, 2) for metres in DISTANCES], dim=1)


def in_field_of_view(points: Float[Tensor, "point 3"], cameras: Cameras) -> Bool[Tensor, "view point"]:
    """Return whether each point lies in each camera's field of view, whatever may stand between them."""
    size = torch.tensor([[cameras.height, cameras.width]], device=points.device).expand(len(cameras), 2)
    poses, intrinsics = cameras.world_from_camera.double(), cameras.intrinsics.double()
    return locate(points[None], poses, intrinsics, size, (1, 1))[2][0]


def _redundant(cameras: Cameras, count: int) -> Int64[Tensor, " frame"]:
    """Return the numbers of so many frames, each that whose view most of those left see; the oldest of equals."""
    seen = in_field_of_view(view_points(cameras).flatten(0, 1), cameras).unflatten(1, (len(cameras), -1))
    seen &= ~torch.eye(len(cameras), dtype=torch.bool, device=seen.device)[..., None]
    seen_by, left = seen.sum(0), torch.ones(len(cameras), dtype=torch.bool, device=seen.device)
    for _ in range(count):
        share = seen_by.double().mean(-1).where(left, -1.0)
        leaving = int(share.argmax())
        seen_by -= seen[leaving].long()
        left[leaving] = False
    return (~left).nonzero()[:, 0]
