"""The world model: backbone, memory and where the agent is, stepped by actions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass

import torch

from persist_cli.api.backbone import Backbone, Clips, Interactions, Sampling
from persist_cli.api.cameras import Cameras
from persist_cli.api.memory import Memory
from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.api.tokens import MemoryTokens
from persist_cli.data.clips import interactions_of
from persist_cli.errors import PersistError


@dataclass(frozen=True)
class ClipRequest:
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
        shared: whether others read this memory too, so that it is copied before it is written.
    """

    backbone: Backbone
    memory: Memory | None
    sampling: Sampling
    seed: int = 0
    write: bool = True
    disturb: Callable[[Observations], Observations] = unchanged
    shared: bool = False

    def reset(self, observation: Observations, info: TrajectoryInfo) -> None:
        """Begin at one observed frame of the world that ``info`` describes."""
        self.now, self.vocabulary, self.clips = observation, info.vocabulary, 0
        self.world_up = torch.tensor(info.world_up, dtype=torch.float64)
        self.memorize(observation)

    def step(self, actions: Sequence[str]) -> Observations:
        """The frames after each of the actions."""
        interactions = interactions_of(actions, self.vocabulary)
        return Observations.concatenate(list(self.imagine(self.cameras_after(actions), interactions)))

    def branches(self, count: int) -> list[WorldModel]:
        """So many world models that go on from here, each on its own, with the same sampling noise.

        Each imagines what this one would. They hold one present frame and one memory until they go on, each of them
        copying the memory when it first writes; this one is not changed.

        Raises:
            PersistError: when none are asked for.
        """
        if count < 1:
            raise PersistError(f"{count} branches of a rollout; it must be at least 1")
        memory = None if self.memory is None else self.memory.copy()
        made = [copy(self) for _ in range(count)]
        for branch in made:
            branch.memory, branch.shared = memory, memory is not None
        return made

    def imagine(self, cameras: Cameras, interactions: Interactions) -> Iterator[Observations]:
        """The frames that the cameras will see, one clip after the other."""
        length = self.backbone.frames_per_clip - 1
        for first in range(0, len(cameras), length):
            part = slice(first, first + length)
            yield self.next_clip(cameras[part], interactions[part])

    def next_clip(self, cameras: Cameras, interactions: Interactions) -> Observations:
        """MemoryIntervention, denoise, observe, memorize."""
        request = self.recall(cameras, interactions)
        rgb, depth = self.denoise(request)
        return self.observe(rgb, depth, cameras)

    def recall(self, cameras: Cameras, interactions: Interactions) -> ClipRequest:
        """What the backbone is asked for the next clip, with what the memory says to its cameras."""
        return recall_together([self], [cameras], [interactions])[0]

    def denoise(self, request: ClipRequest) -> tuple[torch.Tensor, torch.Tensor]:
        """RGB and depth of the clip asked for, its present frame first."""
        rgb, depth = self.backbone.generate(batch_of([request]), self.sampling)
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
        """Write frames into the memory, which is made where the backbone computes."""
        if self.memory is None or not self.write:
            return
        if self.shared:
            self.memory, self.shared = self.memory.copy(), False
        self.memory.write(self.disturb(seen).to(self.backbone.device))

    def cameras_after(self, actions: Sequence[str]) -> Cameras:
        """The cameras after each of the actions."""
        now = self.now.cameras
        poses = self.vocabulary.follow(now.world_from_camera[0], actions, self.world_up)
        return Cameras(poses, now.intrinsics.expand(len(poses), 3, 3), now.height, now.width)

    def clip_path(self, cameras: Cameras) -> Cameras:
        """The present camera and the next ones, the last repeated to fill a clip."""
        missing = self.backbone.frames_per_clip - 1 - len(cameras)
        parts = [self.now.cameras, cameras, *[cameras[-1:]] * missing]
        return Cameras.concatenate(parts)


def step_together(models: Sequence[WorldModel], actions: Sequence[Sequence[str]]) -> list[Observations]:
    """The frames that each of several world models with one backbone sees after its actions; see ``imagine_together``.

    Raises:
        PersistError: when there is no world model, not a list of actions for each, or no action in one.
    """
    if not models or len(models) != len(actions) or not all(actions):
        raise PersistError(
            f"{len(models)} branches were given {len(actions)} lists of {[len(each) for each in actions]} actions; "
            "each needs one of at least one action"
        )
    pairs = list(zip(models, actions, strict=True))
    cameras = [model.cameras_after(each) for model, each in pairs]
    clips = list(imagine_together(models, cameras, [interactions_of(each, model.vocabulary) for model, each in pairs]))
    return [Observations.concatenate([clip[number] for clip in clips]) for number in range(len(models))]


def imagine_together(
    models: Sequence[WorldModel], cameras: Sequence[Cameras], interactions: Sequence[Interactions]
) -> Iterator[list[Observations]]:
    """The next frames of several world models with one backbone, each clip of all of them denoised as one batch.

    As long as they stand at one present frame and read one memory, as ``WorldModel.branches`` do at first, the frame
    is encoded once and the memory is looked through once. A model that has reached the end of its way gives no more
    frames, and its clips are no longer imagined.

    Args:
        models: with one backbone and one way of sampling.
        cameras: of the frames to come, for each model.
        interactions: one for each of them.
    """
    backbone, sampling = models[0].backbone, models[0].sampling
    length = backbone.frames_per_clip - 1
    for first in range(0, max(len(path) for path in cameras), length):
        part = slice(first, first + length)
        going = [number for number, path in enumerate(cameras) if len(path) > first]
        movers, paths = [models[number] for number in going], [cameras[number][part] for number in going]
        requests = recall_together(movers, paths, [interactions[number][part] for number in going])
        rgb, depth = backbone.generate(batch_of(requests), sampling)
        answers = zip(movers, rgb.cpu(), depth.cpu(), paths, strict=True)
        seen = dict(zip(going, (model.observe(*answer) for model, *answer in answers), strict=True))
        yield [seen.get(number, model.now[:0]) for number, model in enumerate(models)]


def recall_together(
    models: Sequence[WorldModel], cameras: Sequence[Cameras], interactions: Sequence[Interactions]
) -> list[ClipRequest]:
    """What the backbone is asked for the next clip of each model; a memory that several read is looked through once."""
    paths = [model.clip_path(each) for model, each in zip(models, cameras, strict=True)]
    readers: dict[int, list[int]] = {}
    for number, model in enumerate(models):
        readers.setdefault(id(model.memory), []).append(number)
    tokens: dict[int, MemoryTokens] = {}
    for numbers in readers.values():
        memory, budget = models[numbers[0]].memory, models[numbers[0]].backbone.token_budget
        if memory is not None:
            told = memory.read_batch([paths[number] for number in numbers], budget)
            tokens |= dict(zip(numbers, told, strict=True))
    return [
        ClipRequest(model.now, path, done, tokens.get(number), clip_seed(model.seed, model.clips))
        for number, (model, path, done) in enumerate(zip(models, paths, interactions, strict=True))
    ]


def batch_of(requests: Sequence[ClipRequest]) -> Clips:
    """A batch for the backbone, the given frame of each question first, or once for all that share one."""
    tokens = [request.tokens for request in requests if request.tokens is not None]
    first = requests[0].path
    given = [request.now for request in requests]
    given = given[:1] if all(now is given[0] for now in given) else given
    return Clips(
        rgb=torch.stack([now.rgb for now in given]),
        depth=torch.stack([now.depth for now in given]),
        cameras=Cameras(
            torch.stack([request.path.world_from_camera for request in requests]),
            torch.stack([request.path.intrinsics for request in requests]),
            first.height,
            first.width,
        ),
        interactions=[request.interactions for request in requests],
        tokens=MemoryTokens.stack(tokens) if tokens else None,
        seeds=[request.seed for request in requests],
    )


def clip_seed(seed: int, clip: int) -> int:
    """A seed for each clip of a rollout, distinct over seeds below 2^31 and a million clips."""
    if seed < 0 or clip >= 1_000_000:
        raise PersistError(f"seed {seed} must not be negative, and a rollout has at most a million clips")
    return seed * 1_000_000 + clip
