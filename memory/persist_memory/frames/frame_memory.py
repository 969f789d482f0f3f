"""The base of memories that keep whole frames with their cameras and read no depth."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import ClassVar

import torch
from jaxtyping import Float, Int64, UInt8
from pydantic import PositiveInt
from torch import Tensor

from persist_cli.api.cameras import Cameras, check_intrinsics, check_poses
from persist_cli.api.memory import Memory, MemoryFigures
from persist_cli.api.observations import Observations, Origin, check_observations
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import DataError
from persist_memory.detail import pixels_across
from persist_memory.validation import check_origins, check_tensors


@dataclass(frozen=True)
class FrameSettings:
    """How many frames are read.

    Args:
        count: the greatest number of frames that one read gives.
    """

    count: PositiveInt = 4


@dataclass(frozen=True)
class FrameStore:
    """Frames of one size with their cameras, in the order in which they were written.

    Args:
        images: uint8 RGB, 0…255.
        world_from_camera: pose of each frame, float64.
        intrinsics: intrinsics of each frame in its pixels, float64.
        origins: the ``Origin`` of each frame.
    """

    images: UInt8[Tensor, "frame height width 3"]
    world_from_camera: Float[Tensor, "frame 4 4"]
    intrinsics: Float[Tensor, "frame 3 3"]
    origins: UInt8[Tensor, " frame"]

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: slice | Tensor) -> FrameStore:
        return FrameStore(**{name: tensor[index] for name, tensor in self.tensors().items()})

    @staticmethod
    def of(observations: Observations) -> FrameStore:
        """The frames without their depth."""
        cameras = observations.cameras
        poses, intrinsics = cameras.world_from_camera.double(), cameras.intrinsics.double()
        return FrameStore(observations.rgb, poses, intrinsics, observations.origins)

    @staticmethod
    def empty(height: int, width: int) -> FrameStore:
        """A store without a frame."""
        return FrameStore(
            torch.zeros(0, height, width, 3, dtype=torch.uint8),
            torch.zeros(0, 4, 4, dtype=torch.float64),
            torch.zeros(0, 3, 3, dtype=torch.float64),
            torch.zeros(0, dtype=torch.uint8),
        )

    @property
    def cameras(self) -> Cameras:
        """The cameras of the frames."""
        height, width = self.images.shape[1:3]
        return Cameras(self.world_from_camera, self.intrinsics, height, width)

    def joined(self, other: FrameStore) -> FrameStore:
        """The frames of this store, then those of another, on the device of this one."""
        device, others = self.images.device, other.tensors()
        return FrameStore(
            **{name: torch.cat([tensor, others[name].to(device)]) for name, tensor in self.tensors().items()}
        )

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


class FrameMemory(Memory):
    """Posed frames, read as one token a frame: its image, its camera, and the mean of its encoder's features.

    The token stands at the camera's centre. No depth is ever seen: ``Memory.memorize`` sets it to 0 on the way in, and
    ``write`` refuses any other. Adapters of the form ``frames`` take the images.
    """

    reads_depth = False
    settings_type: ClassVar[type] = FrameSettings
    settings: FrameSettings
    _store: FrameStore | None = None

    @abstractmethod
    def kept(self, store: FrameStore) -> FrameStore:
        """Return the frames that stay after new ones were added at the end."""

    @abstractmethod
    def choose(self, store: FrameStore, cameras: Cameras, count: int) -> Int64[Tensor, " chosen"]:
        """Return the numbers of at most ``count`` frames for a path of cameras, the most relevant first."""

    def write(self, observations: Observations) -> None:
        """Store the frames.

        Raises:
            DataError: when a pose is not finite and rigid, a frame has depth, or it is of another size than those that
                are stored; then nothing is written.
        """
        where = f"memory {self.name!r}"
        check_observations(observations, where)
        if bool(observations.depth.any()):
            raise DataError(f"{where}: it takes frames without depth; write them by its method memorize")
        if len(observations):
            self._add(FrameStore.of(observations))

    def read(self, cameras: Cameras, budget: int) -> MemoryTokens:
        """Return at most ``budget`` frames, and at most ``count``, the most relevant first."""
        store = self._store if self._store is not None else FrameStore.empty(cameras.height, cameras.width)
        device = store.images.device
        count = min(budget, self.settings.count)
        chosen = store[self.choose(store, cameras.to(device), count)] if len(store) and count else store[:0]
        tokens = MemoryTokens.of(self._features(chosen), chosen.world_from_camera[:, :3, 3])
        return replace(
            tokens,
            origins=chosen.origins,
            images=chosen.images,
            world_from_camera=chosen.world_from_camera,
            intrinsics=chosen.intrinsics,
        )

    def tensors(self) -> dict[str, Tensor]:
        """Return the frames in the order in which they were written."""
        return {} if self._store is None or not len(self._store) else self._store.tensors()

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Replace the frames by what ``tensors()`` gave.

        Raises:
            CheckpointError: when they are not tensors of this memory; then the frames stay as they were.
        """
        if not tensors:
            self._store = None
            return
        where = f"memory {self.name!r}"
        expected = FrameStore.empty(1, 1).tensors()
        shapes = {"images": (None, None, None, 3)}
        sizes = {name: (part.dtype, shapes.get(name, (None, *part.shape[1:]))) for name, part in expected.items()}
        check_tensors(tensors, sizes, where)
        check_origins(tensors, where)
        check_poses(tensors["world_from_camera"].cpu(), where)
        for intrinsics in tensors["intrinsics"]:
            check_intrinsics(intrinsics, where)
        self._store = FrameStore(**tensors)

    def figures(self) -> MemoryFigures:
        """Return the number of frames, their bytes, and how many were imagined; they have no bounds."""
        imagined = 0 if self._store is None else int((self._store.origins == Origin.IMAGINED).sum())
        return replace(super().figures(), imagined=imagined)

    def resolution(self, cameras: Cameras, distance: float = 2.5) -> float:
        """Return the edge of a pixel."""
        return pixels_across(1, cameras, distance)

    def _add(self, frames: FrameStore) -> None:
        """Store more frames; ``DataError`` when they are of another size."""
        store = frames[:0] if self._store is None else self._store
        if store.images.shape[1:] != frames.images.shape[1:]:
            one, other = ("x".join(map(str, part.images.shape[1:3])) for part in (store, frames))
            raise DataError(f"memory {self.name!r}: it holds frames of {one} pixels, a new one has {other}")
        self._store = self.kept(store.joined(frames))

    def _features(self, store: FrameStore) -> Float[Tensor, "frame channel"]:
        if not len(store):
            return torch.zeros(0, self.encoder.channels, device=store.images.device)
        return self.encoder.encoded(store.images).float().mean(dim=(1, 2)).to(store.images.device)


def frame_stores(memories: Sequence[Memory]) -> list[FrameStore]:
    """Return the frames of those memories that hold any."""
    return [memory._store for memory in memories if isinstance(memory, FrameMemory) and memory._store is not None]
