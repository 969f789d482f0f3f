"""Snapshots stored as tensors: patch features, the depth of each patch, and the camera of each image."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor

from persist_cli.api.observations import Observations


@dataclass(frozen=True)
class SnapshotStore:
    """Images cut into the same grid of patches.

    Args:
        grid: rows and columns of patches.
        features: the feature vector of each patch.
        depth: median planar depth of each patch in metres, 0 where nothing was measured.
        colors: mean colour of each patch, for drawing.
        world_from_camera: pose of each image, float64.
        intrinsics: intrinsics of each image, float64.
        size: height and width of each image in pixels.
        content: a hash of each image and its depth, by which stored images are sorted.
    """

    grid: tuple[int, int]
    features: Float[Tensor, "snapshot patch channel"]
    depth: Float[Tensor, "snapshot patch"]
    colors: UInt8[Tensor, "snapshot patch 3"]
    world_from_camera: Float[Tensor, "snapshot 4 4"]
    intrinsics: Float[Tensor, "snapshot 3 3"]
    size: Int64[Tensor, "snapshot 2"]
    content: Int64[Tensor, " snapshot"]

    def __len__(self) -> int:
        return len(self.content)

    def __getitem__(self, index: Tensor) -> SnapshotStore:
        return SnapshotStore(self.grid, **{name: tensor[index] for name, tensor in self.tensors().items()})

    @staticmethod
    def empty(grid: tuple[int, int], channels: int) -> SnapshotStore:
        """A store without a snapshot."""
        patches = grid[0] * grid[1]
        return SnapshotStore(
            grid,
            torch.zeros(0, patches, channels),
            torch.zeros(0, patches),
            torch.zeros(0, patches, 3, dtype=torch.uint8),
            torch.zeros(0, 4, 4, dtype=torch.float64),
            torch.zeros(0, 3, 3, dtype=torch.float64),
            torch.zeros(0, 2, dtype=torch.int64),
            torch.zeros(0, dtype=torch.int64),
        )

    @staticmethod
    def of(
        observations: Observations, features: Float[Tensor, "frame rows columns channel"], grid: tuple[int, int]
    ) -> SnapshotStore:
        """Snapshots of frames, whose feature maps are averaged into the grid of patches."""
        cameras, device = observations.cameras, observations.depth.device
        pooled = torch.nn.functional.adaptive_avg_pool2d(features.float().permute(0, 3, 1, 2), grid)
        colors = torch.nn.functional.adaptive_avg_pool2d(observations.rgb.permute(0, 3, 1, 2).float(), grid)
        return SnapshotStore(
            grid,
            pooled.flatten(2).mT.contiguous(),
            patch_depth(observations.depth, grid).flatten(1),
            colors.round().to(torch.uint8).flatten(2).mT.contiguous(),
            cameras.world_from_camera.double(),
            cameras.intrinsics.double(),
            torch.tensor([[cameras.height, cameras.width]], device=device).expand(len(observations), 2),
            torch.tensor(content_hashes(observations), dtype=torch.int64, device=device),
        )

    def joined(self, other: SnapshotStore) -> SnapshotStore:
        """The snapshots of both stores, sorted, on the device of this one, or of ``other`` when this one is empty."""
        both = self.followed_by(other)
        return both[both.content.argsort(stable=True)]

    def followed_by(self, other: SnapshotStore) -> SnapshotStore:
        """The snapshots of this store, then those of the other, on the device of ``joined``."""
        device = (self if len(self) else other).content.device
        others = other.to(device).tensors()
        return SnapshotStore(
            self.grid, **{name: torch.cat([own, others[name]]) for name, own in self.to(device).tensors().items()}
        )

    def to(self, device: torch.device) -> SnapshotStore:
        """These snapshots on a device."""
        return SnapshotStore(self.grid, **{name: tensor.to(device) for name, tensor in self.tensors().items()})

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name; together with the grid they make the store."""
        return {field.name: getattr(self, field.name) for field in fields(self) if field.name != "grid"}

    @property
    def points(self) -> Float[Tensor, "snapshot patch 3"]:
        """The patches' centres in world metres, float64; the camera's centre where nothing was measured."""
        rows, columns = self.grid
        v = (torch.arange(rows, device=self.depth.device, dtype=torch.float64) + 0.5) / rows
        u = (torch.arange(columns, device=self.depth.device, dtype=torch.float64) + 0.5) / columns
        height, width = self.size.double()[:, :, None].unbind(1)
        pixels = torch.stack(
            [u.repeat(rows) * width, v.repeat_interleave(columns) * height, torch.ones_like(self.depth).double()], -1
        )
        local = pixels @ torch.linalg.inv(self.intrinsics).mT * self.depth.double()[..., None]
        points: Tensor = local @ self.world_from_camera[:, :3, :3].mT + self.world_from_camera[:, None, :3, 3]
        return points


def patch_depth(
    depth: Float[Tensor, "frame height width"], grid: tuple[int, int]
) -> Float[Tensor, "frame rows columns"]:
    """The median valid depth of each patch, 0 where there is none.

    An image whose sides are no multiples of the grid is first enlarged by repeating pixels.
    """
    height, width = (math.ceil(side / cells) * cells for side, cells in zip(depth.shape[1:], grid, strict=True))
    depth = torch.nn.functional.interpolate(depth[:, None].float(), size=(height, width), mode="nearest-exact")[:, 0]
    depth = torch.where(torch.isfinite(depth) & (depth > 0), depth, torch.nan)
    patches = depth.reshape(len(depth), grid[0], height // grid[0], grid[1], width // grid[1])
    median = torch.nanmedian(patches.transpose(2, 3).flatten(3), dim=-1).values
    return torch.where(torch.isnan(median), 0.0, median)


def content_hashes(observations: Observations) -> list[int]:
    """A hash of 63 bits of each frame's pixels and depth, whenever and wherever the frame was taken."""
    rgb, depth = observations.rgb.cpu().contiguous().numpy(), observations.depth.float().cpu().contiguous().numpy()
    hashes = []
    for image, metres in zip(rgb, depth, strict=True):
        digest = hashlib.blake2b(image.tobytes() + metres.tobytes(), digest_size=8).digest()
        hashes.append(int.from_bytes(digest, "little") >> 1)
    return hashes
