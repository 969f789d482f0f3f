"""The world model, which imagines clip by clip what agents will see when they act, and remembers it.

One loop is all of the tool: recall, denoise, observe, memorize. ``WorldModel.imagine`` goes along given cameras, as
evaluations do; ``WorldModel.act`` goes where actions lead, and an agent with a body stops at what is in its way. A
single agent is a batch of one.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from persist_cli.api.backbone import Backbone, Clip, Clips, Interactions, Sampling
from persist_cli.api.cameras import Cameras
from persist_cli.api.ground import Body
from persist_cli.api.memory import Memory
from persist_cli.api.observations import Observations, Origin, TrajectoryInfo
from persist_cli.api.promises import check_generated
from persist_cli.api.scene import Scene
from persist_cli.api.tokens import MemoryTokens
from persist_cli.data.clips import interactions_of
from persist_cli.errors import PersistError
from persist_cli.rollout.arguments import check_starts, checked_actions
from persist_cli.rollout.seeds import clip_seed
from persist_cli.rollout.surroundings import Surroundings, Walk, plan_walks


def unchanged(seen: Observations) -> Observations:
    """Return the frames unchanged."""
    return seen


@dataclass(frozen=True)
class StepResult:
    """What an agent sees after each of its actions, and which of them it could take.

    Args:
        seen: a frame after each action. A blocked action changes nothing, so its frame is the one before it once more.
        free: whether the way of each action was free.
    """

    seen: Observations
    free: Bool[Tensor, " action"]

    @staticmethod
    def concatenate(parts: Sequence[StepResult]) -> StepResult:
        """Join results of one agent, one after the other."""
        return StepResult(
            Observations.concatenate([part.seen for part in parts]), torch.cat([part.free for part in parts])
        )


@dataclass
class Agent:
    """The state of one rollout: its memory, its present frame and the number of its imagined clips.

    Args:
        memory: the memory that the adapter reads; ``None`` without an adapter.
        seed: seed of the sampling noise.
        write: whether observed and imagined frames are written into the memory.
        disturb: changes frames before they are written, as an evaluation with noisy poses does.
        shared: whether other agents read this memory too, so that it is copied before it is written or imagines.
        body: what of it can be blocked; ``None`` for a camera that goes through walls.
    """

    memory: Memory | None
    seed: int = 0
    write: bool = True
    disturb: Callable[[Observations], Observations] = unchanged
    shared: bool = False
    body: Body | None = None
    reads: list[tuple[int, int]] = field(default_factory=list, init=False)  # tokens and bytes, of each clip
    now: Observations = field(init=False)
    info: TrajectoryInfo = field(init=False)
    clips: int = field(default=0, init=False)
    surroundings: Surroundings | None = field(default=None, init=False)  # ``None`` without a body

    def begin(self, observation: Observations, info: TrajectoryInfo) -> None:
        """Stand at an observed frame; its info has the frame's scene, up axis and vocabulary."""
        self.now, self.info, self.clips = observation, info, 0
        self.surroundings = None
        if self.body is not None:
            self.surroundings = Surroundings(self.body, observation, info, self.memory)

    def branch(self, memory: Memory | None) -> Agent:
        """Return an agent in this one's state, with a memory that it shares with others."""
        branch = Agent(memory, self.seed, self.write, self.disturb, memory is not None, self.body)
        branch.now, branch.info, branch.clips = self.now, self.info, self.clips
        branch.surroundings = self.surroundings and self.surroundings.copy()
        return branch

    def walk(self) -> Walk:
        """Return a walk without an action yet, from the present frame."""
        return Walk(self.info, self.now.cameras, self.surroundings if self.body is not None else None)

    @property
    def scene(self) -> Scene | None:
        """The memory, if it is a scene, which imagines what will be seen and in which interactions change things."""
        return self.memory if isinstance(self.memory, Scene) else None

    def set_out(self, actions: Sequence[str], most: int) -> Walk:
        """Return a walk from the present frame; in a scene its first action is taken if it is an interaction.

        The scene imagines first what the agent will see, so that it stops at imagined walls too.

        Args:
            actions: the next actions; without any nothing is done.
            most: number of moves that a clip holds.
        """
        if self.scene is None or not actions:
            return self.walk()
        walk = self.interact(actions[0]) if self.info.vocabulary[actions[0]].interaction else self.walk()
        self.look_ahead(self.next_clip(actions)[len(walk.names) :], most)
        return walk

    def look_ahead(self, actions: Sequence[str], most: int) -> None:
        """Let the scene imagine what will be seen on the way as far as it is free by what is known, and know that."""
        assert self.scene is not None
        trial = self.walk()
        plan_walks([trial], [actions], most)
        self.foresee(self.now.cameras.at(torch.stack([self.now.cameras.world_from_camera[0].double(), *trial.poses])))
        if self.surroundings is not None:
            self.surroundings.know(self.scene)

    def foresee(self, path: Cameras) -> None:
        """Let the memory make ready to be read along a path; one that others share is not changed by what it imagines.

        As long as a shared scene has nothing to imagine there, it stays shared.
        """
        scene = self.scene
        if scene is None or not self.shared or not scene.imagines:
            if self.memory is not None:
                self.memory.foresee([path])
            return
        before, own = scene.cells, scene.copy()
        own.foresee([path])
        if own.cells is not before:
            self.memory, self.shared = own, False

    def interact(self, action: str) -> Walk:
        """Let an interaction change the scene, and return a walk that begins with it."""
        if self.shared and self.memory is not None:
            self.memory, self.shared = self.memory.copy(), False
        scene, walk = self.scene, self.walk()
        assert scene is not None
        before = scene.cells
        done = scene.act(self.info.vocabulary[action], walk.pose, self.body or Body())
        if done and self.surroundings is not None:
            self.surroundings.changed(scene, before)
        walk.take(action, walk.after(action), done)
        return walk

    def next_clip(self, actions: Sequence[str]) -> Sequence[str]:
        """Return the first of some actions that one clip may show: in a scene an interaction begins a new clip."""
        if self.scene is None:
            return actions
        later = (n for n, name in enumerate(actions) if n > 0 and self.info.vocabulary[name].interaction)
        return actions[: next(later, len(actions))]

    def cameras_after(self, actions: Sequence[str]) -> Cameras:
        """Return the cameras after each of the actions, starting at the present frame."""
        return cameras_along(self.now.cameras, self.info, actions)

    def notice(self, seen: Observations) -> Observations:
        """Let imagined frames count for what is in the way of later actions, and return them."""
        if self.surroundings is not None:
            self.surroundings.see(seen)
        return seen

    def observe(self, seen: Observations) -> None:
        """Make the last of the frames the present one, and count their clip."""
        self.stand_at(seen[-1:])
        self.clips += 1

    def stand_at(self, frame: Observations) -> None:
        """Make a single frame the present one; neither the clip is counted nor anything remembered."""
        self.now = frame

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
        clip_frames: frames of a clip, the present one included: with 2 each action is a clip of its own, which takes
            less time than a whole clip, but more a frame. By default as many as in training.

    Raises:
        PersistError: when the backbone cannot make clips of so many frames.
    """

    def __init__(
        self, backbone: Backbone, agents: Sequence[Agent], sampling: Sampling, clip_frames: int | None = None
    ) -> None:
        self.backbone, self.agents, self.sampling = backbone, list(agents), sampling
        self.clip_frames = backbone.frames_per_clip if clip_frames is None else clip_frames

    @property
    def clip_frames(self) -> int:
        """Frames of a clip, the present one included; ``PersistError`` when the backbone cannot make such clips."""
        return self._clip_frames

    @clip_frames.setter
    def clip_frames(self, frames: int) -> None:
        if frames != self.backbone.frames_per_clip:
            self.backbone.check_clip_frames(frames)
        self._clip_frames = frames

    def reset(self, observations: Sequence[Observations], infos: Sequence[TrajectoryInfo]) -> None:
        """Let each agent begin at one observed frame; its info has the frame's scene, up axis and vocabulary.

        Raises:
            PersistError: when there is not one whole frame for each agent; nothing has changed then.
        """
        check_starts(observations, infos, len(self.agents))
        for agent, observation, info in zip(self.agents, observations, infos, strict=True):
            agent.begin(observation, info)
            agent.memorize(observation, self.backbone.device)

    def step(self, actions: Sequence[Sequence[str]], check_again: bool = True) -> list[StepResult]:
        """Return for each agent what it sees after each of its actions; arguments and errors as of ``act``."""
        return [StepResult.concatenate(parts) for parts in zip(*self.act(actions, check_again), strict=True)]

    def act(self, actions: Sequence[Sequence[str]], check_again: bool = True) -> Iterator[list[StepResult]]:
        """Yield for each imagined clip what every agent sees after some of its next actions, until none is left.

        A step is blocked where the ground on its way is known to be occupied: by what the agent observed, by what its
        memory held at the start, or by what it imagined since. Unknown ground counts as free. A blocked action does not
        move the agent. Agents without a body are never blocked.

        In a scene an interaction is done before the frames after it are imagined, and is refused where the scene
        forbids it: its frame is then the one before it once more. In other memories it changes nothing by itself.

        Args:
            actions: for each agent at least one name of its vocabulary.
            check_again: whether each clip's own depth is looked at too. An agent then stops at a wall that only this
                clip shows, what was imagined behind the wall is dropped, and the rest of its actions gets another clip.
                It costs some milliseconds a frame and now and then a clip; planners that compare many short futures
                leave it out.

        Raises:
            PersistError: before ``reset``, and when the actions are not such lists; nothing has changed then.
        """
        left = checked_actions(actions, [getattr(agent, "info", None) for agent in self.agents])
        while any(left):
            most, agents = self.clip_frames - 1, self.agents
            walks = [agent.set_out(names, most) for agent, names in zip(agents, left, strict=True)]
            rests = [
                agent.next_clip(names)[len(walk.names) :]
                for agent, names, walk in zip(agents, left, walks, strict=True)
            ]
            plan_walks(walks, rests, most)
            results = self.follow(walks, check_again)
            left = [names[len(walk.names) :] for names, walk in zip(left, walks, strict=True)]
            yield results

    def follow(self, walks: Sequence[Walk], check_again: bool) -> list[StepResult]:
        """Imagine a clip of each walk that moves, cut where it proves blocked, and return what every agent sees."""
        moving = [number for number, walk in enumerate(walks) if walk.poses]
        interactions = [interactions_of(walks[n].moves, walks[n].info.vocabulary) for n in moving]
        clips = self.predict(moving, [walks[n].cameras for n in moving], interactions) if moving else []
        imagined = dict(zip(moving, clips, strict=True))
        results = []
        for number, (agent, walk) in enumerate(zip(self.agents, walks, strict=True)):
            now, seen = agent.now, imagined.get(number, agent.now[:0])
            if number in imagined:
                seen = self.stopped(agent, walk, seen) if check_again else agent.notice(seen)
                self.take(agent, seen)
            results.append(StepResult(walk.frames(now, seen), walk.verdicts))
        return results

    def stopped(self, agent: Agent, walk: Walk, seen: Observations) -> Observations:
        """Return the frames of a clip up to the first action that they show to be blocked, and cut the walk there.

        What is returned counts for later actions.
        """
        if walk.surroundings is None or agent.surroundings is None:
            return seen
        stop = agent.surroundings.first_blocked(seen)
        if stop is None:
            return seen
        walk.cut(stop)
        return seen[:stop]

    def branches(self, count: int) -> WorldModel:
        """Return a world model with ``count`` agents in the state of the first agent, with the same sampling noise.

        Each imagines what the first agent would. They share its present frame and a copy of its memory, which each
        copies again when it first writes or imagines; this world model is not changed.

        Raises:
            PersistError: when ``count`` is less than 1.
        """
        if count < 1:
            raise PersistError(f"{count} branches of a rollout; it must be at least 1")
        agent = self.agents[0]
        memory = None if agent.memory is None else agent.memory.copy()
        branches = copy.copy(self)  # of this one's class
        branches.agents = [agent.branch(memory) for _ in range(count)]
        return branches

    def imagine(self, cameras: Sequence[Cameras], interactions: Sequence[Interactions]) -> Iterator[list[Observations]]:
        """Yield for each clip the frames of every agent along its cameras, none for an agent at the end of its path.

        Nothing is in the way of a camera, with or without a body, and in a scene interactions change nothing.

        As long as all agents have one present frame and one memory, as those of ``branches`` do at first, the frame is
        encoded once and the memory is read once.

        Args:
            cameras: for each agent the cameras of the frames to come.
            interactions: for each agent the interaction before each of these frames.
        """
        length = self.clip_frames - 1
        for first in range(0, max(map(len, cameras)), length):
            clip = slice(first, first + length)
            moving = [number for number, path in enumerate(cameras) if len(path) > first]
            ways = [cameras[number][clip] for number in moving]
            seen = self.predict(moving, ways, [interactions[number][clip] for number in moving])
            frames = [agent.now[:0] for agent in self.agents]
            for number, part in zip(moving, seen, strict=True):
                self.take(self.agents[number], self.agents[number].notice(part))
                frames[number] = part
            yield frames

    def predict(
        self, moving: Sequence[int], ways: Sequence[Cameras], interactions: Sequence[Interactions]
    ) -> list[Observations]:
        """Return what some agents would see along their next cameras; arguments as of ``recall``."""
        rgb, depth = self.denoise(self.recall(moving, ways, interactions))
        return [
            Observations(rgb[row, 1 : len(way) + 1], depth[row, 1 : len(way) + 1], way).with_origin(Origin.IMAGINED)
            for row, way in enumerate(ways)
        ]

    def take(self, agent: Agent, seen: Observations) -> None:
        """Let an agent go on from the last of the frames that it imagined, and remember them."""
        agent.observe(seen)
        agent.memorize(seen, self.backbone.device)

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

    @torch.no_grad()
    def denoise(
        self, clips: Clips
    ) -> tuple[UInt8[Tensor, "agent frame height width 3"], Float[Tensor, "agent frame height width"]]:
        """Return RGB and depth in metres of the clips on the CPU, their first frames the present ones."""
        cameras = clips.cameras
        shape = (*cameras.world_from_camera.shape[:2], cameras.height, cameras.width)
        return self._generated(self.backbone.generate(clips, self.sampling), shape)

    @torch.no_grad()
    def denoise_frame(
        self, clips: Clips, frames: Sequence[int]
    ) -> tuple[UInt8[Tensor, "agent height width 3"], Float[Tensor, "agent height width"]]:
        """Return RGB and depth of a single frame of each clip on the CPU; 0 is the present one.

        It takes less time than whole clips where the codec codes frames alone.
        """
        shape = (len(frames), clips.cameras.height, clips.cameras.width)
        return self._generated(self.backbone.generate_frame(clips, self.sampling, frames), shape)

    def _generated(self, images: Any, shape: tuple[int, ...]) -> tuple[Tensor, Tensor]:
        """Generated RGB and depth on the CPU, after a check that they are what the backbone promises."""
        check_generated(images, self.backbone.name, shape)
        rgb, depth = images
        return rgb.cpu(), depth.cpu()

    def clip_path(self, agent: Agent, way: Cameras) -> Cameras:
        """Return the present camera and the next ones, the last of them repeated to fill a clip."""
        missing = self.clip_frames - 1 - len(way)
        return Cameras.concatenate([agent.now.cameras, way, *[way[-1:]] * missing])

    def read_memories(self, agents: Sequence[Agent], paths: Sequence[Cameras]) -> list[MemoryTokens | None]:
        """Return the tokens of each agent's path, ``None`` without memory; a memory of several agents is read once."""
        tokens: list[MemoryTokens | None] = [None] * len(agents)
        for agent, path in zip(agents, paths, strict=True):
            agent.foresee(path)
        for memory in {id(agent.memory): agent.memory for agent in agents}.values():
            if memory is None:
                continue
            readers = [number for number, agent in enumerate(agents) if agent.memory is memory]
            wanted = [paths[number] for number in readers]
            for number, sample in zip(readers, self.read_memory(memory, wanted), strict=True):
                tokens[number] = sample
                agents[number].reads.append((self.backbone.count_tokens(sample, paths[number]), sample.bytes))
        return tokens

    def read_memory(self, memory: Memory, paths: Sequence[Cameras]) -> list[MemoryTokens]:
        """Return a memory's tokens of each path: one sample for all where tokens are drawn and the memory has that."""
        together = len(paths) > 1 and self.backbone.draws_tokens
        return memory.recall(paths, self.backbone.token_budget, together)


def cameras_along(camera: Cameras, info: TrajectoryInfo, actions: Sequence[str]) -> Cameras:
    """Return the cameras after each of the actions.

    Args:
        camera: the camera before the first action, with a frame axis of one.
        info: up axis and vocabulary of the trajectory.
        actions: names in the vocabulary.
    """
    world_up = torch.tensor(info.world_up, dtype=torch.float64)
    poses = info.vocabulary.follow(camera.world_from_camera[0], actions, world_up)
    return camera.at(poses)
