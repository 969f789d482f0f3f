"""The world model, which imagines clip by clip what agents will see when they act, and remembers it.

``WorldModel.imagine`` is the one loop of the tool: recall, denoise, observe, memorize. Rollouts and evaluations use it;
a single agent is a batch of one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from persist_cli.api.backbone import Backbone, Clip, Clips, Interactions, Sampling
from persist_cli.api.cameras import Cameras
from persist_cli.api.memory import Memory
from persist_cli.api.observations import Observations, Origin, TrajectoryInfo
from persist_cli.api.tokens import MemoryTokens
from persist_cli.data.clips import interactions_of
from persist_cli.errors import PersistError


def unchanged(seen: Observations) -> Observations:
    """Return the frames unchanged."""
    return seen


@dataclass
class Agent:
    """The state of one rollout: its memory, its present frame and the number of its imagined clips.

    Args:
        memory: the memory that the adapter reads; ``None`` without an adapter.
        seed: seed of the sampling noise.
        write: whether observed and imagined frames are written into the memory.
        disturb: changes frames before they are written, as an evaluation with noisy poses does.
        shared: whether other agents read this memory too, so that it is copied before it is written.
    """

    memory: Memory | None
    seed: int = 0
    write: bool = True
    disturb: Callable[[Observations], Observations] = unchanged
    shared: bool = False
    reads: list[tuple[int, int]] = field(default_factory=list, init=False)  # tokens and bytes, of each clip
    now: Observations = field(init=False)
    info: TrajectoryInfo = field(init=False)
    clips: int = field(default=0, init=False)

    def cameras_after(self, actions: Sequence[str]) -> Cameras:
        """Return the cameras after each of the actions, starting at the present frame."""
        return cameras_along(self.now.cameras, self.info, actions)

    def observe(self, seen: Observations) -> None:
        """Make the last of the frames the present one, and count their clip."""
        self.now, self.clips = seen[-1:], self.clips + 1

    def memorize(self, seen: Observations, device: torch.device) -> None:
        """Write frames into the memory on ``device``, unless there is no memory or it is not written."""
        if self.memory is None or not self.write:
            return
        if self.shared:
            self.memory, self.shared = self.memory.copy(), False
        self.memory.memorize(self.disturb(seen).to(device))


class WorldModel:
    """Predicts clip by clip what agents will see, and remembers it; the clips of all agents are denoised as a batch.

    Args:
        backbone: the backbone, which already uses the adapter, if any.
        agents: one agent for each rollout.
        sampling: steps, sampler and guidance of each clip.
    """

    def __init__(self, backbone: Backbone, agents: Sequence[Agent], sampling: Sampling) -> None:
        self.backbone, self.agents, self.sampling = backbone, list(agents), sampling

    def reset(self, observations: Sequence[Observations], infos: Sequence[TrajectoryInfo]) -> None:
        """Let each agent begin at one observed frame; its info has the frame's scene, up axis and vocabulary."""
        for agent, observation, info in zip(self.agents, observations, infos, strict=True):
            agent.now, agent.info, agent.clips = observation, info, 0
            agent.memorize(observation, self.backbone.device)

    def step(self, actions: Sequence[Sequence[str]]) -> list[Observations]:
        """Return for each agent the frames that it sees after each of its actions.

        Raises:
            PersistError: when there is not one list of actions for each agent, or a list is empty.
        """
        if not self.agents or len(self.agents) != len(actions) or not all(actions):
            raise PersistError(
                f"{len(self.agents)} branches were given {len(actions)} lists of {[*map(len, actions)]} "
                "actions; each needs one of at least one action"
            )
        pairs = list(zip(self.agents, actions, strict=True))
        cameras = [agent.cameras_after(names) for agent, names in pairs]
        clips = list(self.imagine(cameras, [interactions_of(names, agent.info.vocabulary) for agent, names in pairs]))
        return [Observations.concatenate(parts) for parts in zip(*clips, strict=True)]

    def branches(self, count: int) -> WorldModel:
        """Return a world model with ``count`` agents in the state of the first agent, with the same sampling noise.

        Each imagines what the first agent would. They share its present frame and a copy of its memory, which each
        copies again when it first writes; this world model is not changed.

        Raises:
            PersistError: when ``count`` is less than 1.
        """
        if count < 1:
            raise PersistError(f"{count} branches of a rollout; it must be at least 1")
        agent = self.agents[0]
        memory = None if agent.memory is None else agent.memory.copy()
        agents = [Agent(memory, agent.seed, agent.write, agent.disturb, memory is not None) for _ in range(count)]
        for branch in agents:
            branch.now, branch.info, branch.clips = agent.now, agent.info, agent.clips
        return WorldModel(self.backbone, agents, self.sampling)

    def imagine(self, cameras: Sequence[Cameras], interactions: Sequence[Interactions]) -> Iterator[list[Observations]]:
        """Yield for each clip the frames of every agent, which are none for an agent at the end of its path.

        As long as all agents have one present frame and one memory, as those of ``branches`` do at first, the frame is
        encoded once and the memory is read once.

        Args:
            cameras: for each agent the cameras of the frames to come.
            interactions: for each agent the interaction before each of these frames.
        """
        length = self.backbone.frames_per_clip - 1
        for first in range(0, max(map(len, cameras)), length):
            clip = slice(first, first + length)
            moving = [number for number, path in enumerate(cameras) if len(path) > first]
            ways = [cameras[number][clip] for number in moving]
            clips = self.recall(moving, ways, [interactions[number][clip] for number in moving])
            rgb, depth = self.denoise(clips)
            frames = [agent.now[:0] for agent in self.agents]
            for row, (number, way) in enumerate(zip(moving, ways, strict=True)):
                new = slice(1, len(way) + 1)
                seen = Observations(rgb[row, new], depth[row, new], way).with_origin(Origin.IMAGINED)
                self.agents[number].observe(seen)
                self.agents[number].memorize(seen, self.backbone.device)
                frames[number] = seen
            yield frames

    def recall(self, moving: Sequence[int], ways: Sequence[Cameras], interactions: Sequence[Interactions]) -> Clips:
        """Return the clips that the backbone shall predict: present frames, cameras to come and memory tokens.

        Args:
            moving: numbers of the agents that go on.
            ways: their next cameras, at most those of one clip.
            interactions: for each of these agents the interaction before each frame.
        """
        agents = [self.agents[number] for number in moving]
        paths = [self.clip_path(agent, way) for agent, way in zip(agents, ways, strict=True)]
        tokens = self.read_memories(agents, paths)
        clips = Clips.stack(
            [
                Clip(Observations(agent.now.rgb, agent.now.depth, path), acts, clip_seed(agent.seed, agent.clips), read)
                for agent, path, acts, read in zip(agents, paths, interactions, tokens, strict=True)
            ]
        )
        if all(agent.now is agents[0].now for agent in agents):  # one frame for all is encoded once
            clips = dataclasses.replace(clips, rgb=clips.rgb[:1], depth=clips.depth[:1])
        return clips

    def denoise(
        self, clips: Clips
    ) -> tuple[UInt8[Tensor, "agent frame height width 3"], Float[Tensor, "agent frame height width"]]:
        """Return RGB and depth in metres of the clips on the CPU, their first frames the present ones."""
        rgb, depth = self.backbone.generate(clips, self.sampling)
        return rgb.cpu(), depth.cpu()

    def clip_path(self, agent: Agent, way: Cameras) -> Cameras:
        """Return the present camera and the next ones, the last of them repeated to fill a clip."""
        missing = self.backbone.frames_per_clip - 1 - len(way)
        return Cameras.concatenate([agent.now.cameras, way, *[way[-1:]] * missing])

    def read_memories(self, agents: Sequence[Agent], paths: Sequence[Cameras]) -> list[MemoryTokens | None]:
        """Return the tokens of each agent's path, ``None`` without memory; a memory of several agents is read once."""
        tokens: list[MemoryTokens | None] = [None] * len(agents)
        for memory in {id(agent.memory): agent.memory for agent in agents}.values():
            if memory is None:
                continue
            readers = [number for number, agent in enumerate(agents) if agent.memory is memory]
            batch = memory.read_batch([paths[number] for number in readers], self.backbone.token_budget)
            for number, sample in zip(readers, batch, strict=True):
                tokens[number] = sample
                agents[number].reads.append((self.backbone.count_tokens(sample, paths[number]), sample.bytes))
        return tokens


def cameras_along(camera: Cameras, info: TrajectoryInfo, actions: Sequence[str]) -> Cameras:
    """Return the cameras after each of the actions.

    Args:
        camera: the camera before the first action, with a frame axis of one.
        info: up axis and vocabulary of the trajectory.
        actions: names in the vocabulary.
    """
    world_up = torch.tensor(info.world_up, dtype=torch.float64)
    poses = info.vocabulary.follow(camera.world_from_camera[0], actions, world_up)
    return Cameras(poses, camera.intrinsics.expand(len(poses), 3, 3), camera.height, camera.width)


def clip_seed(seed: int, clip: int) -> int:
    """Return the seed of a clip of a rollout, distinct for all seeds below 2^31 and a million clips."""
    if seed < 0 or clip >= 1_000_000:
        raise PersistError(f"seed {seed} must not be negative, and a rollout has at most a million clips")
    return seed * 1_000_000 + clip
