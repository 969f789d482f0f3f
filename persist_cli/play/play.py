"""A walk with the keys through what one or several world models imagine.

For example ``play.advance(frozenset({"forward"}))`` gives the next frame while W is held, again and again. There are no
sockets and no threads here; a server calls one method at a time.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Collection, Mapping

from persist_cli.api.actions import Action
from persist_cli.api.backbone import Sampling
from persist_cli.api.observations import Observations, Trajectory, TrajectoryInfo
from persist_cli.play.keys import held_actions, walking_keys
from persist_cli.play.settings import GroundPose, PlaySettings, Shown
from persist_cli.play.walkers import Ahead, Pose, Walkers
from persist_cli.rollout.world_model import WorldModel


class Play:
    """One walker under the same keys in the world models of several memories.

    All of them hold the same pose, and what the first one knows to be in the way stops the walker in all.

    Args:
        worlds: world models of one agent each, which has not begun, by the name of its memory.
        start: the observed frame at which the walk begins, with its scene and vocabulary.
        settings: how frames are imagined.
        model: name of the checkpoint, for people.
    """

    def __init__(
        self, worlds: Mapping[str, WorldModel], start: Trajectory, settings: PlaySettings, model: str = ""
    ) -> None:
        self.model, self._start = model, start
        self._walkers = Walkers(worlds)
        self._number = -1
        self._ahead: Ahead | None = None
        self._done: frozenset[str] = frozenset()  # interactions that are still held and were done
        self.settings = settings
        self.set(settings)
        self.shown = self.reset()

    @property
    def memories(self) -> tuple[str, ...]:
        """The names of the memories, in the order in which they are shown."""
        return tuple(self._walkers.worlds)

    @property
    def info(self) -> TrajectoryInfo:
        """Scene, image size, up axis and vocabulary."""
        return self._start.info

    @property
    def actions(self) -> tuple[Action, ...]:
        """The actions that may be held."""
        return walking_keys(self.info.vocabulary)

    def set(self, settings: PlaySettings) -> None:
        """Take other settings from the next clip on; what is imagined and not shown yet is dropped.

        Raises:
            PersistError: when the model cannot imagine with them; then they stay as they were.
        """
        worlds = list(self._walkers.worlds.values())
        samplings = [self._sampling(world, settings) for world in worlds]
        for world, sampling in zip(worlds, samplings, strict=True):
            world.backbone.check_sampling(sampling)
        frames = settings.clip_frames
        for world, sampling in zip(worlds, samplings, strict=True):
            world.clip_frames = world.backbone.frames_per_clip if frames is None else frames  # refused by the first
            world.sampling, world.agents[0].seed = sampling, settings.seed
        self.settings, self._ahead = settings, None

    def reset(self, seed: int | None = None) -> Shown:
        """Begin again at the start, with the memories as they were there, and return the start frame.

        Args:
            seed: another seed of the sampling noise.
        """
        if seed is not None:
            self.set(dataclasses.replace(self.settings, seed=seed))
        self._ahead, self._done = None, frozenset()
        self._walkers.begin(self._start.observations, self.info)
        return self._show(None, True, time.monotonic())

    def advance(self, held: Collection[str]) -> Shown | None:
        """Return the next frame under the held actions, or ``None`` when there is nothing new to show.

        Several actions are combined as ``held_actions`` says. An interaction is done once for each time that it is
        newly held. When other actions are held than before, the frames imagined for the old ones are dropped. A blocked
        action is shown once, with the frame before it; then ``None`` comes until other actions are held.

        Args:
            held: names of the vocabulary's actions.

        Raises:
            DataError: for an unknown action; nothing changes then.
        """
        begun = time.monotonic()
        actions = self._next_actions(frozenset(held))
        ahead = self._ahead
        if not actions:
            self._ahead = None
            return None
        if ahead is None or ahead.actions != actions or not (ahead.left or ahead.stuck):
            ahead = self._ahead = self._walkers.imagine(actions)
        elif ahead.stuck:
            return None
        name = ahead.names[ahead.taken]
        return self._show(name, self._walkers.show(ahead), begun)

    def _next_actions(self, held: frozenset[str]) -> tuple[str, ...]:
        """Return the actions to take in turn: an interaction that is newly held, else what moves."""
        moving = held_actions(held, self.info.vocabulary)
        done = self._done & held
        fresh = sorted(name for name in held - done if self.info.vocabulary[name].interaction)
        self._done = done | frozenset(fresh[:1])
        if fresh:
            self._ahead = None
        return tuple(fresh[:1]) or moving

    def home(self) -> Shown:
        """Stand at the start pose again, and return what is imagined there; nothing is forgotten."""
        return self._jump(self._start.observations.cameras.world_from_camera[0])

    def _jump(self, pose: Pose) -> Shown:
        begun, self._ahead = time.monotonic(), None
        self._walkers.stand_at(self._walkers.look_from(pose))
        return self._show(None, True, begun)

    def _show(self, action: str | None, free: bool, begun: float) -> Shown:
        """Return the present frames as shown now, and keep them as ``shown``."""
        self._number += 1
        frames: list[Observations] = [agent.now for agent in self._walkers.agents]
        images = {name: frame.rgb[0] for name, frame in zip(self.memories, frames, strict=True)}
        pose = GroundPose.of(self._walkers.pose, self.info.world_up)
        milliseconds = 1000 * (time.monotonic() - begun)
        self.shown = Shown(self._number, action, free, pose, images, milliseconds)
        return self.shown

    @staticmethod
    def _sampling(world: WorldModel, settings: PlaySettings) -> Sampling:
        return dataclasses.replace(world.sampling, steps=settings.steps, memory_guidance=settings.guidance)
