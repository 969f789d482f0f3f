"""What a world model imagines at a camera that was placed by hand, with the memory as it is edited now."""

from __future__ import annotations

import math
import threading
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from persist_cli.api.checkpoint import PLAIN, Checkpoint, find_checkpoint, reference_checkpoint
from persist_cli.api.geometry import pose_differences
from persist_cli.api.memory import Memory
from persist_cli.api.memory_file import read_header
from persist_cli.checkpoints.load import adapter_memory
from persist_cli.data.clips import interactions_of
from persist_cli.data.store import TrajectoryFile
from persist_cli.errors import PersistError
from persist_cli.rollout.open_world import WorldOptions, check_cells, check_memory, empty_memory, world_with
from persist_cli.rollout.world_model import WorldModel

STEP: Final = 0.25  # metres from frame to frame on the way to the camera
TURN: Final = 15.0  # degrees
MOST_CLIPS: Final = 4  # on the way; farther off a step is longer
TURN_COSTS: Final = 1 / 90  # metres that a degree counts for, when the nearest true frame is sought


@dataclass(frozen=True)
class ImagineSettings:
    """The world model that imagines.

    Args:
        checkpoint: a run, a checkpoint or ``reference``; ``None`` for the one that comes with the package.
        adapter: name of its memory adapter; ``None`` for one that reads the memory, or its default.
        seed: of the sampling noise.
    """

    checkpoint: Path | None = None
    adapter: str | None = None
    seed: int = 0


@dataclass(frozen=True)
class ImaginedView:
    """A picture on the way to a camera that was placed by hand.

    Args:
        picture: what is seen there.
        began: number of the true frame from which the way goes.
        frames: how many frames were imagined up to this one; 0 for the true frame itself.
        arrived: whether this is what is seen at the camera.
    """

    picture: UInt8[Tensor, "height width 3"]
    began: int
    frames: int = 0
    arrived: bool = False


class Imaginer:
    """Imagines views, one at a time; the model is loaded once, by ``load`` or at the first view.

    Args:
        settings: the world model.
        start: a trajectory of the scene; what is imagined begins at that of its true frames that is nearest.
        file: the memory's file, ``None`` to imagine with what is remembered on each way alone.
    """

    def __init__(self, settings: ImagineSettings, start: TrajectoryFile, file: Path | None) -> None:
        self.settings, self.start, self.file = settings, start, file
        self._world: WorldModel | None = None
        self._empty: Memory | None = None  # what the adapter reads, on the model's device
        self._lock = threading.Lock()  # one view at a time

    @property
    def loaded(self) -> bool:
        """Whether the model is there."""
        return self._world is not None

    def find(self) -> Checkpoint:
        """Return the checkpoint, without loading it.

        Raises:
            CheckpointError: when it is not there, or has no adapter of the name.
        """
        checkpoint = find_checkpoint(self.settings.checkpoint or reference_checkpoint())
        if self.settings.adapter not in (None, PLAIN):
            checkpoint.adapter_folder(self.settings.adapter)
        return checkpoint

    def load(self, memory: Memory | None) -> None:
        """Load the model that reads a memory, so that the first view need not wait; errors as of ``imagine``."""
        with self._lock:
            self._opened(memory)

    def imagine(self, pose: Float[Tensor, "4 4"], memory: Memory | None) -> Generator[ImaginedView, None, None]:
        """Yield the nearest true frame, then the last frame of each clip on the way to a pose.

        Args:
            pose: world_from_camera.
            memory: the memory to read; it stays as it is.

        Raises:
            PersistError: when model, memory and data do not go together.
            OSError: when a file cannot be read.
        """
        number = nearest_frame(self.start.poses(), pose)
        part = self.start.read([number])
        yield ImaginedView(part.observations.rgb[0], number)
        with self._lock:
            world = self._opened(memory)
            self._remember(world, memory)
            world.reset([part.observations], [part.info])
            first = part.observations.cameras
            cameras = first.at(way_to(first.world_from_camera[0], pose, world.backbone.frames_per_clip - 1))
            none, frames = interactions_of((None,) * len(cameras), part.info.vocabulary), 0
            for [clip] in world.imagine([cameras], [none]):
                frames += len(clip)
                yield ImaginedView(clip.rgb[-1], number, frames, frames == len(cameras))

    def _remember(self, world: WorldModel, memory: Memory | None) -> None:
        """Give the agent a copy of a memory, which it leaves as it is, or an empty one, which it writes."""
        agent = world.agents[0]
        agent.write = memory is None
        if self._empty is not None:
            agent.memory = (self._empty if memory is None else memory).copy()
            agent.memory.encoder = self._empty.encoder  # that of the page's memory stays where it is
            agent.memory.placed(world.backbone.device)

    def _opened(self, memory: Memory | None) -> WorldModel:
        if self._world is None:
            checkpoint, info = self.find(), self.start.info
            adapter = self._adapter(checkpoint, memory)
            options = WorldOptions(
                start=self.start.path.name, memory=self.file, adapter=self.settings.adapter, write=False,
                seed=self.settings.seed, body=False,
            )  # fmt: skip
            empty = empty_memory(checkpoint, adapter, options, info)
            if memory is not None and empty is not None and self.file is not None:
                check_memory(read_header(self.file), empty, checkpoint, self.file)
                check_cells(memory, empty, self.file)
            self._world = world_with(empty, checkpoint, adapter, options, info)
            self._empty = self._world.agents[0].memory
        return self._world

    def _adapter(self, checkpoint: Checkpoint, memory: Memory | None) -> str | None:
        """Return the adapter that is named, else one that reads the memory, else the default."""
        if self.settings.adapter is not None or memory is None:
            return checkpoint.chosen_adapter(self.settings.adapter)
        readers = [name for name in checkpoint.adapters if adapter_memory(checkpoint, name).name == memory.name]
        if not readers:
            raise PersistError(
                f"{checkpoint.folder}: no adapter of it reads a memory of kind {memory.name!r}; name a model that "
                f"does by --checkpoint (it has {', '.join(checkpoint.adapters) or 'none'})"
            )
        default = checkpoint.default
        return default if default in readers else readers[0]


def nearest_frame(poses: Float[Tensor, "frame 4 4"], pose: Float[Tensor, "4 4"]) -> int:
    """Return the number of the pose that is nearest to another one; 90 degrees count as one metre."""
    metres, degrees = pose_differences(poses, pose.to(poses).expand(len(poses), 4, 4))
    return int((metres + degrees * TURN_COSTS).argmin())


def way_to(first: Float[Tensor, "4 4"], last: Float[Tensor, "4 4"], clip: int) -> Float[Tensor, "frame 4 4"]:
    """Return poses on the straight way from one to another, whole clips of them, the last one included.

    Args:
        first: world_from_camera at the beginning, which is left out.
        last: that at the end.
        clip: frames of a clip.
    """
    from scipy.spatial.transform import Rotation, Slerp  # a sixth of the start of a page that imagines nothing

    metres, degrees = pose_differences(first.double(), last.double())
    steps = max(float(metres) / STEP, float(degrees) / TURN, 1.0)
    count = clip * min(MOST_CLIPS, math.ceil(steps / clip))
    shares = np.arange(1, count + 1) / count
    ends = np.stack([first.double().numpy(), last.double().numpy()])
    turned = Slerp([0, 1], Rotation.from_matrix(ends[:, :3, :3]))(shares).as_matrix()
    poses = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    poses[:, :3, :3] = torch.from_numpy(turned)
    poses[:, :3, 3] = torch.from_numpy(ends[0, :3, 3] + shares[:, None] * (ends[1, :3, 3] - ends[0, :3, 3]))
    poses[-1] = last.double()
    return poses
