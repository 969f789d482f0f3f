"""The world model: backbone, memory and where the agent is, stepped by actions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch

from persist_cli.trajectories.clips import interactions_of
from persist_cli.world.backbone import Backbone, Clips, Interactions, Sampling
from persist_cli.world.cameras import Cameras
from persist_cli.world.errors import PersistError
from persist_cli.world.memory import Memory
from persist_cli.world.observations import Observations, TrajectoryInfo
from persist_cli.world.tokens import MemoryTokens


@dataclass(frozen=True)
class Question:
    """What a backbone is asked for one clip.

    Args:
        now: the present frame.
        path: cameras of the whole clip, the present one first.
        interactions: for each step.
        tokens: of the memory, ``None`` without one.
        seed: of the sampling noise.
    """

    now: Observations
    path: Cameras
    interactions: Interactions
    tokens: MemoryTokens | None
    seed: int


def unchanged(seen: Observations) -> Observations:
    """The same frames."""
    return seen


@dataclass
class WorldModel:
    """Predicts what an agent will see, clip by clip, and remembers it.

    Args:
        backbone: with the adapter to use, if any, already in use.
        memory: what the adapter reads; ``None`` without adapter.
        sampling: how clips are drawn.
        seed: of the sampling noise.
        write: whether what is seen and generated goes into the memory.
        disturb: changes frames before they are written, as an evaluation with noisy poses does.
    """

    backbone: Backbone
    memory: Memory | None
    sampling: Sampling
    seed: int = 0
    write: bool = True
    disturb: Callable[[Observations], Observations] = unchanged

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
        question = self.recall(cameras, interactions)
        rgb, depth = self.denoise(question)
        return self.observe(rgb, depth, cameras)

    def recall(self, cameras: Cameras, interactions: Interactions) -> Question:
        """What the backbone is asked for the next clip, with what the memory says to its cameras."""
        path = self.clip_path(cameras)
        tokens = None if self.memory is None else self.memory.read(path, self.backbone.token_budget)
        return Question(self.now, path, interactions, tokens, clip_seed(self.seed, self.clips))

    def denoise(self, question: Question) -> tuple[torch.Tensor, torch.Tensor]:
        """RGB and depth of the clip asked for, its present frame first."""
        rgb, depth = self.backbone.generate(batch_of([question]), self.sampling)
        return rgb[0].cpu(), depth[0].cpu()

    def observe(self, rgb: torch.Tensor, depth: torch.Tensor, cameras: Cameras) -> Observations:
        """The generated frames at the cameras asked for, after going there and memorizing them.

        Args:
            rgb: uint8 ``[frame, height, width, 3]``, the present frame first.
            depth: metres, likewise.
            cameras: of the frames after the present one.
        """
        seen = Observations(rgb[1 : len(cameras) + 1], depth[1 : len(cameras) + 1], cameras)
        self.memorize(seen)
        self.now, self.clips = seen[-1:], self.clips + 1
        return seen

    def memorize(self, seen: Observations) -> None:
        """Write frames into the memory."""
        if self.memory is not None and self.write:
            self.memory.write(self.disturb(seen))

    def clip_path(self, cameras: Cameras) -> Cameras:
        """The present camera and the next ones, the last repeated to fill a clip."""
        missing = self.backbone.frames_per_clip - 1 - len(cameras)
        parts = [self.now.cameras, cameras, *[cameras[-1:]] * missing]
        return Cameras.concatenate(parts)


def imagine_together(
    models: Sequence[WorldModel], cameras: Sequence[Cameras], interactions: Sequence[Interactions]
) -> Iterator[list[Observations]]:
    """The next frames of several world models with one backbone, each clip of all of them denoised as one batch.

    Args:
        models: with one backbone and one way of sampling.
        cameras: of the frames to come, as many for each model.
        interactions: one for each of them.
    """
    backbone, sampling = models[0].backbone, models[0].sampling
    length = backbone.frames_per_clip - 1
    for first in range(0, len(cameras[0]), length):
        part = slice(first, first + length)
        questions = [
            model.recall(path[part], done[part])
            for model, path, done in zip(models, cameras, interactions, strict=True)
        ]
        rgb, depth = backbone.generate(batch_of(questions), sampling)
        answers = zip(models, rgb.cpu(), depth.cpu(), cameras, strict=True)
        yield [model.observe(colors, metres, path[part]) for model, colors, metres, path in answers]


def batch_of(questions: Sequence[Question]) -> Clips:
    """A batch for the backbone, the given frame of each question first."""
    tokens = [question.tokens for question in questions if question.tokens is not None]
    first = questions[0].path
    return Clips(
        rgb=torch.stack([question.now.rgb for question in questions]),
        depth=torch.stack([question.now.depth for question in questions]),
        cameras=Cameras(
            torch.stack([question.path.world_from_camera for question in questions]),
            torch.stack([question.path.intrinsics for question in questions]),
            first.height,
            first.width,
        ),
        interactions=[question.interactions for question in questions],
        tokens=MemoryTokens.stack(tokens) if tokens else None,
        seeds=[question.seed for question in questions],
    )


def clip_seed(seed: int, clip: int) -> int:
    """A seed for each clip of a rollout, distinct over seeds below 2^31 and a million clips."""
    if seed < 0 or clip >= 1_000_000:
        raise PersistError(f"seed {seed} must not be negative, and a rollout has at most a million clips")
    return seed * 1_000_000 + clip
