"""The world model: backbone, memory and where the agent is, stepped by actions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch

from persist_cli.trajectories.clips import interactions_of
from persist_cli.world.backbone import Backbone, Clips, Interactions, Sampling
from persist_cli.world.cameras import Cameras
from persist_cli.world.errors import PersistError
from persist_cli.world.memory import Memory
from persist_cli.world.observations import Observations, TrajectoryInfo
from persist_cli.world.tokens import MemoryTokens


@dataclass
class WorldModel:
    """Predicts what an agent will see, clip by clip, and remembers it.

    Args:
        backbone: with the adapter to use, if any, already in use.
        memory: what the adapter reads; ``None`` without adapter.
        sampling: how clips are drawn.
        seed: of the sampling noise.
        write: whether what is seen and generated goes into the memory.
    """

    backbone: Backbone
    memory: Memory | None
    sampling: Sampling
    seed: int = 0
    write: bool = True

    def reset(self, observation: Observations, info: TrajectoryInfo) -> None:
        """Begin at one observed frame of the world that ``info`` describes."""
        self.now, self.vocabulary, self.clips = observation, info.vocabulary, 0
        self.world_up = torch.tensor(info.world_up, dtype=torch.float64)
        self.memorize(observation)

    def step(self, actions: Sequence[str]) -> Observations:
        """The frames after each of the actions."""
        poses = self.vocabulary.follow(self.now.cameras.world_from_camera[0], actions, self.world_up)
        cameras = Cameras(
            poses, self.now.cameras.intrinsics.expand(len(poses), 3, 3), self.now.cameras.height, self.now.cameras.width
        )
        return Observations.concatenate(list(self.imagine(cameras, interactions_of(actions, self.vocabulary))))

    def imagine(self, cameras: Cameras, interactions: Interactions) -> Iterator[Observations]:
        """The frames that the cameras will see, one clip after the other."""
        length = self.backbone.frames_per_clip - 1
        for first in range(0, len(cameras), length):
            part = slice(first, first + length)
            yield self.next_clip(cameras[part], interactions[part])

    def next_clip(self, cameras: Cameras, interactions: Interactions) -> Observations:
        """Recall, denoise, observe, memorize."""
        path = self.clip_path(cameras)
        tokens = self.recall(path)
        rgb, depth = self.denoise(path, interactions, tokens)
        seen = Observations(rgb[1 : len(cameras) + 1], depth[1 : len(cameras) + 1], cameras)
        self.memorize(seen)
        self.now, self.clips = seen[-1:], self.clips + 1
        return seen

    def recall(self, path: Cameras) -> MemoryTokens | None:
        """What the memory says to the cameras of a clip."""
        return None if self.memory is None else self.memory.read(path, self.backbone.token_budget)

    def denoise(
        self, path: Cameras, interactions: Interactions, tokens: MemoryTokens | None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """RGB and depth of a clip from the frame where the agent is."""
        batch = Clips(
            rgb=self.now.rgb[None],
            depth=self.now.depth[None],
            cameras=Cameras(path.world_from_camera[None], path.intrinsics[None], path.height, path.width),
            interactions=[interactions],
            tokens=None if tokens is None else MemoryTokens.stack([tokens]),
            seeds=[clip_seed(self.seed, self.clips)],
        )
        rgb, depth = self.backbone.generate(batch, self.sampling)
        return rgb[0].cpu(), depth[0].cpu()

    def memorize(self, seen: Observations) -> None:
        """Write frames into the memory."""
        if self.memory is not None and self.write:
            self.memory.write(seen)

    def clip_path(self, cameras: Cameras) -> Cameras:
        """The present camera and the next ones, the last repeated to fill a clip."""
        missing = self.backbone.frames_per_clip - 1 - len(cameras)
        parts = [self.now.cameras, cameras, *[cameras[-1:]] * missing]
        return Cameras.concatenate(parts)


def clip_seed(seed: int, clip: int) -> int:
    """A seed for each clip of a rollout, distinct over seeds below 2^31 and a million clips."""
    if seed < 0 or clip >= 1_000_000:
        raise PersistError(f"seed {seed} must not be negative, and a rollout has at most a million clips")
    return seed * 1_000_000 + clip
