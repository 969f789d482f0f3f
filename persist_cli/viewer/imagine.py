"""What a world model imagines at a camera that was placed by hand, with the memory as it is edited now."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from persist_cli.api.checkpoint import Checkpoint, find_checkpoint, reference_checkpoint
from persist_cli.api.geometry import pose_differences
from persist_cli.api.inference import InferenceOptions, SamplingOverrides
from persist_cli.api.memory import Memory
from persist_cli.checkpoints.load import adapter_memory
from persist_cli.data.clips import interactions_of
from persist_cli.data.store import TrajectoryFile
from persist_cli.errors import PersistError
from persist_cli.rollout.camera_path import RolloutPlan
from persist_cli.rollout.open_world import assemble_world
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
    """A picture of a camera that was placed by hand.

    Args:
        picture: what the model imagines there.
        began: number of the true frame from which it went there.
        frames: frames that it imagined on the way, this one included.
    """

    picture: UInt8[Tensor, "height width 3"]
    began: int
    frames: int


class Imaginer:
    """Imagines views; the model is loaded at the first one and stays.

    Args:
        settings: the world model.
        start: a trajectory of the scene; what is imagined begins at that of its true frames that is nearest.
        file: the memory's file, ``None`` to imagine with a memory of the true frame alone.
    """

    def __init__(self, settings: ImagineSettings, start: TrajectoryFile, file: Path | None) -> None:
        self.settings, self.start, self.file = settings, start, file
        self._world: WorldModel | None = None
        self._lock = threading.Lock()  # one view at a time

    def imagine(self, pose: Float[Tensor, "4 4"], memory: Memory | None) -> ImaginedView:
        """Return what the model imagines at a pose.

        Args:
            pose: world_from_camera.
            memory: the memory to read; it stays as it is.

        Raises:
            PersistError: when model, memory and data do not go together.
        """
        with self._lock:
            world = self._opened(memory)
            number = nearest_frame(self.start.poses(), pose)
            part = self.start.read([number])
            agent = world.agents[0]
            if memory is not None and agent.memory is not None:
                agent.memory = memory.copy().to(world.backbone.device)
            agent.write = memory is None
            world.reset([part.observations], [part.info])
            cameras = part.observations.cameras.at(
                way_to(part.observations.cameras.world_from_camera[0], pose, world.backbone.frames_per_clip - 1)
            )
            none = interactions_of((None,) * len(cameras), part.info.vocabulary)
            seen = [clip for [clip] in world.imagine([cameras], [none])]
            return ImaginedView(seen[-1].rgb[-1], number, len(cameras))

    def _opened(self, memory: Memory | None) -> WorldModel:
        if self._world is None:
            checkpoint = find_checkpoint(self.settings.checkpoint or reference_checkpoint())
            adapter = self._adapter(checkpoint, memory)
            plan = RolloutPlan(
                self.start.path.name, (), True, 0, self.file, adapter, False, self.settings.seed,
                SamplingOverrides(), InferenceOptions(),
            )  # fmt: skip
            self._world = assemble_world(checkpoint, adapter, plan, self.start.info)
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
