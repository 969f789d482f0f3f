"""A house that the world model imagines, as an environment: nothing but its memory and a start frame is true."""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from torch import Tensor

from persist_cli.api.checkpoint import REFERENCE, find_checkpoint
from persist_cli.api.ground import GroundMap
from persist_cli.api.inference import SamplingOverrides
from persist_cli.api.memory_file import is_memory_file
from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.environments.environment import HouseEnv, HouseVectorEnv, Scenes
from persist_cli.environments.goals import SEEN, Goals, KnownGround, PosedFrames, find_goals
from persist_cli.environments.task import Attempt, TaskSettings, View
from persist_cli.errors import CheckpointError, DataError
from persist_cli.io.settings import parse_settings
from persist_cli.navigation.ground_mapper import GroundMapper, body_of, knows_floor
from persist_cli.navigation.routes import check_within_reach
from persist_cli.rollout.camera_path import walking_vocabulary
from persist_cli.rollout.open_world import WorldOptions, assemble_world
from persist_cli.rollout.seeds import SEEDS
from persist_cli.rollout.world_model import Agent, WorldModel

NAME: Final = "persist/ImaginedHouse-v0"

TRIES: Final = 100  # starts that are drawn before it is said that no goal is far enough


@dataclass(frozen=True, kw_only=True)
class ImaginedSettings(TaskSettings):
    """The house of ``persist/ImaginedHouse-v0``, beside its task.

    Args:
        start: frame of a data set, as in ``runs/houses#0:32``; of several, as in ``runs/houses#0:0-33``, one is drawn.
        goal: frames of a data set, as for the start; ``[x, y, z]`` in world metres; ``random``: free known ground; or
            ``seen``: free ground that the start frames show, whatever else a memory file knows or imagined.
        checkpoint: a run, an export or ``reference``, the model that comes with the package.
        adapter: name of a memory adapter, by default the checkpoint's own; ``stage1`` for none.
        memory: a file of ``persist memorize``, or frames of a data set to make one of; ``None`` for an empty memory.
        write: whether what is imagined is written into the memory, for the episode; given frames always are.
        collide: whether the agent is stopped by what it saw, remembers or imagined, or walks through walls; ``None``
            stops it where the data tell how high its camera is, as a simulator's do.
        sampling: steps, sampler and guidance in place of the checkpoint's own.
        step: metres of an action, in place of the data set's own.
        turn: degrees of an action.
        clip_frames: frames of a clip, the present one included, at least 2; ``None`` for as few as show ``chunk``
            actions, which takes the least time.
    """

    start: str
    goal: str | tuple[float, float, float]
    checkpoint: str = REFERENCE
    adapter: str | None = None
    memory: str | None = None
    write: bool = True
    collide: bool | None = None
    sampling: SamplingOverrides = field(default_factory=SamplingOverrides)
    step: float | None = None
    turn: float | None = None
    clip_frames: int | None = None

    @property
    def memory_file(self) -> Path | None:
        """The file of the memory, ``None`` where frames are named or nothing is."""
        return None if self.memory is None or not is_memory_file(self.memory) else Path(self.memory)

    @property
    def given_frames(self) -> PosedFrames | None:
        """The frames that the memory is made of, ``None`` where there are none."""
        return PosedFrames(self.memory) if self.memory is not None and self.memory_file is None else None


class ImaginedScenes(Scenes):
    """One house, imagined for several agents in one batch; each episode begins with the memory as it was given.

    Args:
        settings: house and task.
        count: number of environments.

    Raises:
        PersistError: one line when something is missing or damaged, or does not go together.
    """

    def __init__(self, settings: ImaginedSettings, count: int = 1) -> None:
        self.starts, self.given = PosedFrames(settings.start), settings.given_frames
        if self.given is not None:
            self.given.check_scene(self.starts.info.scene)
        world, info = open_house(settings, self.starts)
        super().__init__(info, settings)
        self.world, self.first = world, world.agents[0]
        shortest = world.backbone.shortest_clip(settings.chunk)
        world.clip_frames = settings.clip_frames if settings.clip_frames is not None else shortest
        if self.given is not None:
            memorize_frames(world, self.given)
        self.known = KnownGround(self._map(settings), body_of(info).radius, settings)
        free = Goals(self._free_places(settings), info.scene, (info.height, info.width))
        self.goals = find_goals(settings.goal, free, settings.observe_goal)
        if not isinstance(settings.goal, str):
            self._check_place()
        self._agents = [self.first] * count
        self._goals = [0] * count

    def _check_place(self) -> None:
        """Raise ``DataError`` when the goal is a place farther away than ways are looked for."""
        memory = self.first.memory
        known = [self.starts.positions, *([] if memory is None else [memory.points().positions])]
        name = f"goal {tuple(self.goals.positions[0].tolist())}"
        check_within_reach(name, self.goals.positions[0], self.known.ground, known)

    def begin(self, number: int, draws: np.random.Generator, options: Mapping[str, Any]) -> Attempt:
        """Draw a start, a goal and the seed of the noise; there are no options."""
        if options:
            raise DataError(f"options of reset ({', '.join(options)}): an imagined house has none; see its settings")
        start, goal = self._draw(draws)
        frame = self.starts[start]
        first = self.first
        agent = Agent(first.memory, int(draws.integers(SEEDS)), shared=True, body=first.body)
        self._world([agent]).reset([frame], [self.info])  # what it sees there is true, so it is remembered
        agent.write = first.write
        self._agents[number], self._goals[number] = agent, goal
        (view,) = self._views(number, frame, [True])
        return Attempt(view, self.goals.goal(goal), self.info.world_up, self.task)

    def walk(self, actions: Mapping[int, Sequence[str]]) -> dict[int, list[View]]:
        """Let the agents act; what all of them see is imagined in one batch."""
        world = self._world([self._agents[number] for number in actions])
        steps = zip(actions, world.step(list(actions.values())), strict=True)
        return {number: self._views(number, step.seen, step.free.tolist()) for number, step in steps}

    def _world(self, agents: list[Agent]) -> WorldModel:
        """The world model with some agents."""
        world = copy.copy(self.world)
        world.agents = agents
        return world

    def _draw(self, draws: np.random.Generator) -> tuple[int, int]:
        """Draw a start, and a goal that is as far from it as the task says."""
        for _ in range(TRIES):
            start = int(draws.integers(len(self.starts)))
            metres = self.known.metres(self.goals.positions, self.starts.positions[start])
            if len(metres) == 1 and len(self.starts) == 1:
                far = (metres > self.task.success_radius).nonzero()[:, 0]
            else:
                low, high = self.task.goal_distance
                far = ((metres >= low) & (metres <= high)).nonzero()[:, 0]
            if len(far):
                return start, int(far[int(draws.integers(len(far)))])
        raise DataError(self._too_near())

    def _too_near(self) -> str:
        low, high = self.task.goal_distance
        if len(self.goals.positions) == 1 and len(self.starts) == 1:
            return f"{self.starts.text}: its goal is within the success_radius of {self.task.success_radius:g} m"
        return f"{self.starts.text}: none of its goals is {low:g} to {high:g} m away; set goal_distance"

    def _views(self, number: int, seen: Observations, free: Sequence[bool]) -> list[View]:
        """What an agent saw, with the metres to its goal."""
        poses = seen.cameras.world_from_camera.cpu()
        left = self.known.metres(poses[:, :3, 3], self.goals.positions[self._goals[number]])
        rows = zip(seen.rgb.cpu(), seen.depth.cpu(), poses, left.tolist(), free, strict=True)
        return [View(rgb.numpy(), depth.numpy(), pose.double().numpy(), m, was) for rgb, depth, pose, m, was in rows]

    def _free_places(self, settings: ImaginedSettings) -> Float[Tensor, "place 3"]:
        """Where a goal without a name may lie, in world metres: on free known ground, and where it has to, seen."""
        if settings.goal != SEEN:
            return self.known.free_places(self.starts.positions)
        seen = KnownGround(self._map(settings, remembered=False), self.known.radius, settings)
        places = seen.free_places(self.starts.positions)
        return places[self.known.can_reach(places, self.starts.positions)]

    def _map(self, settings: ImaginedSettings, remembered: bool = True) -> GroundMap:
        """What is known of the ground: from the memory or the frames that it was made of, and the start frames.

        Nothing is known where the height of the camera is not; see ``knows_floor``.

        Args:
            settings: say which memory there is.
            remembered: whether more is known than what the start frames show.
        """
        if not knows_floor(self.info, self.first.body):
            return GroundMap.empty(self.info.world_up)
        body = body_of(self.info)
        mapper = GroundMapper(self.info.world_up, body)
        for frames in filter(None, [self.given if remembered else None, self.starts]):
            for source in frames.sources:
                for piece in source.pieces():
                    mapper.add(piece)
        if remembered and settings.memory_file is not None and self.first.memory is not None:
            mapper.add_memory(self.first.memory, mapper.floor_under(self.starts.positions.mean(0)))
        return mapper.map()


def open_house(settings: ImaginedSettings, starts: PosedFrames) -> tuple[WorldModel, TrajectoryInfo]:
    """Return a world model with one agent, which has not begun, and the start's info with the actions to take."""
    checkpoint = find_checkpoint(Path(settings.checkpoint))
    adapter = checkpoint.chosen_adapter(settings.adapter)
    vocabulary = walking_vocabulary(starts.file, settings.start, settings.step, settings.turn)
    info = replace(starts.info, vocabulary=vocabulary)
    if adapter is None and settings.memory is not None:
        raise CheckpointError(f"{checkpoint.folder}: without a memory adapter it cannot read {settings.memory}")
    options = WorldOptions(
        start=settings.start, memory=settings.memory_file, adapter=settings.adapter, write=settings.write,
        sampling=settings.sampling, body=settings.collide,
    )  # fmt: skip
    return assemble_world(checkpoint, adapter, options, info), info


def memorize_frames(world: WorldModel, frames: PosedFrames) -> None:
    """Write given frames into the memory of the world's agent, also where it writes nothing that it imagines."""
    memory = world.agents[0].memory
    if memory is None:
        return
    for source in frames.sources:
        for piece in source.pieces():
            memory.memorize(piece.to(world.backbone.device))


class ImaginedHouse(HouseEnv):
    """An imagined house: ``gymnasium.make("persist/ImaginedHouse-v0", start="sample#0:32", goal="sample#0:0")``.

    Args:
        render_mode: ``rgb_array`` or ``None``.
        settings: those of ``ImaginedSettings``.

    Raises:
        PersistError: one line with what is wrong in the settings, or missing.
    """

    def __init__(self, render_mode: str | None = None, **settings: Any) -> None:
        super().__init__(ImaginedScenes(imagined_settings(settings)), render_mode)


class ImaginedHouseVector(HouseVectorEnv):
    """Several agents in one imagined house, whose frames are imagined in one batch.

    For example ``gymnasium.make_vec("persist/ImaginedHouse-v0", num_envs=8, start="sample#0:32", goal="sample#0:0")``.

    Args:
        num_envs: number of environments.
        max_episode_steps: steps after which an episode is truncated.
        render_mode: ``rgb_array`` or ``None``.
        settings: those of ``ImaginedSettings``.

    Raises:
        PersistError: as ``ImaginedHouse``.
    """

    def __init__(
        self, num_envs: int = 1, max_episode_steps: int | None = None, render_mode: str | None = None, **settings: Any
    ) -> None:
        scenes = ImaginedScenes(imagined_settings(settings), num_envs)
        super().__init__(scenes, num_envs, max_episode_steps, render_mode)


def imagined_settings(settings: Mapping[str, Any]) -> ImaginedSettings:
    """Return the settings of plain values, where paths may stand for their text."""
    texts = {name: os.fspath(value) if isinstance(value, os.PathLike) else value for name, value in settings.items()}
    return parse_settings(ImaginedSettings, texts, NAME)
