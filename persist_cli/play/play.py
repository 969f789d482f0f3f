"""A walk with the keys through what one or several world models imagine.

For example ``play.advance(frozenset({"forward"}))`` gives the next frame while W is held, again and again. There are no
sockets and no threads here; a server calls one method at a time.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Final

from persist_cli.api.actions import Action
from persist_cli.api.inference import Sampling
from persist_cli.api.observations import Observations, Origin, Trajectory, TrajectoryInfo
from persist_cli.api.policy import Goal
from persist_cli.errors import PersistError
from persist_cli.play.ground import check_free, pose_at
from persist_cli.play.ground_picture import GroundPicture
from persist_cli.play.guide import Guide
from persist_cli.play.keys import held_actions, walking_keys
from persist_cli.play.recording import Recording, SavedRecording
from persist_cli.play.settings import GROWTH, GroundPose, PlaySettings, Shown
from persist_cli.play.surveyor import Surveyor
from persist_cli.play.walkers import Ahead, Pose, Walkers
from persist_cli.plugins import make_cost
from persist_cli.rollout.world_model import WorldModel

THOUGHT: Final = 1  # what is imagined ahead is as long as this clip under newly held keys, counted from 0
COST: Final = "lpips"  # says how unlike the goal picture a view looks


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
        self._thoughts: dict[tuple[str, ...], Ahead] = {}  # clips from the present state, by their actions
        self._last: tuple[str, ...] = ()  # actions that were held last
        self._turn = 0  # number of the one of these whose turn is next
        self._blocked = 0  # of these, one after the other
        self._clips = 0  # that were shown under these
        self._done: frozenset[str] = frozenset()  # interactions that are still held and were done
        self._recording: Recording | None = None
        self._goal: Goal | None = None
        self._guide: Guide | None = None
        self._rest: tuple[str, ...] = ()  # of the way that the planner decided on, after the clip
        self.settings = settings
        self.set(settings)
        self._walkers.begin(start.observations, start.info)
        self._surveyor = Surveyor(self._walkers)
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

    @property
    def notices(self) -> tuple[str, ...]:
        """What somebody who walks here should know, a line each."""
        if all(world.backbone.gives_depth for world in self._walkers.worlds.values()):
            return ()
        readers = [
            name
            for name, agent in zip(self.memories, self._walkers.agents, strict=True)
            if agent.memory is not None and agent.memory.reads_depth
        ]
        stays = f", and {', '.join(readers)} cannot remember it" if readers else ""
        return (f"this model imagines no depth: what it imagines stops nobody{stays}",)

    @property
    def takes_autoguidance(self) -> bool:
        """Whether the model has a guide, away from which it can sample (``autoguidance``)."""
        return all(world.backbone.guide_folder is not None for world in self._walkers.worlds.values())

    def set(self, settings: PlaySettings) -> None:
        """Take other settings from the next clip on; what is imagined and not shown yet is dropped.

        Raises:
            PersistError: when the model cannot imagine with them; then they stay as they were.
        """
        worlds = list(self._walkers.worlds.values())
        samplings = [self._sampling(world, settings) for world in worlds]
        for world, sampling in zip(worlds, samplings, strict=True):
            world.backbone.check_sampling(sampling)
        self._lengths = self._clip_lengths(settings)
        for world, sampling in zip(worlds, samplings, strict=True):
            world.sampling, world.agents[0].seed = sampling, settings.seed
        self.settings = settings
        self._drop()

    def reset(self, seed: int | None = None) -> Shown:
        """Begin again at the start, with the memories as they were there, and return the start frame.

        Args:
            seed: another seed of the sampling noise.
        """
        if seed is not None:
            self.set(dataclasses.replace(self.settings, seed=seed))
        begun = time.monotonic()
        self._drop()
        self._walkers.begin(self._start.observations, self.info)
        self._walkers.set_clip_frames(self._lengths[-1])
        if int(self._start.observations.origins[0]) == Origin.IMAGINED:  # a drawing, which the model sees as a frame
            self._walkers.stand_at(self._walkers.look_from(self._walkers.pose))
            self._walkers.begin_here()
        self._surveyor.begin()
        self._record(None)
        return self._show(None, True, begun)

    def advance(self, held: Collection[str], pressed: Collection[str] = ()) -> Shown | None:
        """Return the next frame under the held actions, or ``None`` when there is nothing new to show.

        Several actions are combined as ``held_actions`` says. An interaction is done once for each time that it is
        newly held. When other actions are held than before, the frames imagined for the old ones are dropped. A blocked
        action is shown once, with the frame before it; then ``None`` comes until other actions are held.

        Args:
            held: names of the vocabulary's actions.
            pressed: those that were pressed since the last call. One that is held counts as newly held; one that was
                let go again acts now, before what is held.

        Raises:
            DataError: for an unknown action; nothing changes then.
        """
        begun = time.monotonic()
        actions = self._next_actions(frozenset(held), frozenset(pressed))
        if not actions:
            return self._guided(begun)
        self.stop()
        if actions != self._last or set(pressed) & set(held):
            self._last = actions
            self._let_go()
            self._turn = next((number for number, name in enumerate(actions) if name in pressed), 0)
        if self._blocked >= len(actions):
            return None
        if self._ahead is None or not self._ahead.left:
            actions = actions[self._turn :] + actions[: self._turn]
            self._ahead = self._thoughts.pop(actions, None) or self._imagine(actions, self._clips)
            self._clips += 1
        self._turn = (self._turn + 1) % len(actions)
        return self._take(self._ahead, begun)

    def think(self, seconds: float) -> bool:
        """Imagine what the likely next actions lead to, while nobody waits, and return whether more is left to imagine.

        Each clip is imagined alone, so that a key waits for one at most: on a processor a batch of clips takes no less
        time. What was imagined is dropped as soon as anything else is shown. It may be longer than the first clip under
        newly held keys, and a model that denoises all frames of a clip together then shows somewhat other pictures.

        Args:
            seconds: after which no further clip is begun; one that is begun is finished.
        """
        begun = time.monotonic()
        while (actions := self._next_thought()) is not None:
            if time.monotonic() - begun >= seconds:
                return True
            self._thoughts[actions] = self._imagine(actions, THOUGHT)
        return False

    def undo(self) -> Shown | None:
        """Go back to the frame before the present one, and forget that; ``None`` where no more can be undone.

        At least ``UNDO`` frames can be undone. A blocked action is no frame of its own.
        """
        begun = time.monotonic()
        if not self._walkers.undo():
            return None
        self._drop()
        self._surveyor.undo()
        if self._recording is not None:
            if len(self._recording) > 1:
                self._recording.undo()
            else:  # what is undone was shown before the recording
                self._recording = Recording(self.memories, self._frames)
        return self._show(None, True, begun)

    def _guided(self, begun: float) -> Shown | None:
        """Return the planner's next frame; ``None`` while it decides, when it has ended, and when it does not walk."""
        if self._guide is None:
            self._let_go()
            return None
        if self._ahead is None or not self._ahead.left or self._blocked:
            self._walkers.remember()
            self._walkers.set_clip_frames(self._lengths[-1])
            rest = () if self._blocked else self._rest  # a way may be longer than a clip
            actions = rest or self._guide.decide(next(iter(self._walkers.worlds.values())))
            if actions is None:
                return None
            if not actions:
                self.stop()
                return self._guided(begun)
            self._ahead, self._blocked = self._walkers.imagine(actions, repeat=False), 0
            self._rest = actions[len(self._ahead.names) :]
        return self._take(self._ahead, begun)

    def _next_actions(self, held: frozenset[str], pressed: frozenset[str]) -> tuple[str, ...]:
        """Return the actions to take in turn: an interaction that is newly pressed, else what moves."""
        moving = held_actions(pressed - held or held, self.info.vocabulary)
        done = self._done & held - pressed
        fresh = sorted(name for name in (held | pressed) - done if self.info.vocabulary[name].interaction)
        self._done = done | frozenset(fresh[:1])
        if fresh:
            self._last = ()
        return tuple(fresh[:1]) or moving

    @property
    def goal(self) -> Goal | None:
        """The picture that the planner looks for, and where it was taken; ``None`` before one is taken."""
        return self._goal

    def take_goal(self) -> None:
        """Make the present frame of the first memory the goal; a planner that walks to another one stops."""
        self.stop()
        now = self._walkers.lead.now
        self._goal = Goal(now.rgb[0].cpu(), now.cameras.centers[0].cpu().double(), self.info.scene)

    @property
    def planning(self) -> bool:
        """Whether the planner walks."""
        return self._guide is not None

    def plan(self) -> None:
        """Let the planner walk to the goal picture; ``advance`` without held actions shows its steps.

        A decision takes several calls of ``advance``, of up to some seconds each, which give ``None``. It walks as long
        as ``planning`` is true. A held action stops it.

        Raises:
            PersistError: when there is no goal, or the weights are missing that compare pictures.
        """
        if self._goal is None:
            raise PersistError("there is no goal picture yet; take one, walk away, and let it be looked for")
        self._drop()
        self._last, self._rest = (), ()  # so that a key after the planner is newly held
        self._guide = Guide(self._goal, make_cost(COST, {}), self.settings.seed)

    def stop(self) -> None:
        """Let the planner stop."""
        self._guide = None

    def home(self) -> Shown:
        """Stand at the start pose again, and return what is imagined there; nothing is forgotten."""
        return self._jump(self._start.observations.cameras.world_from_camera[0])

    def jump(self, x: float, y: float) -> Shown:
        """Stand at another place with the same heading, and return what is imagined there; nothing is forgotten.

        Args:
            x: metres along the first ground axis.
            y: metres along the second.

        Raises:
            PersistError: when the place is not on ground known to be free; without a body all places are allowed.
        """
        check_free(self._walkers.lead.surroundings, x, y)
        return self._jump(pose_at(self._walkers.pose, x, y, self.info))

    def map(self, size: int = 512) -> GroundPicture:
        """Return the map of what the first memory holds, seen from above, with the way and the start.

        What is imagined is pale with stripes. A memory without places shows the ground as far as it is known. What was
        shown last may be missing until the next clip begins.

        Args:
            size: pixels of the longer side.
        """
        if self._ahead is None or not self._ahead.left:
            self._walkers.remember()
        return self._surveyor.draw(size, self._goal)

    @property
    def recording(self) -> bool:
        """Whether there is a recording, which is not saved yet."""
        return self._recording is not None

    @property
    def recording_is_full(self) -> bool:
        """Whether no more frames are recorded, since there are ``LONGEST`` already; it is still to be saved."""
        return self._recording is not None and self._recording.full

    def record(self) -> None:
        """Begin a recording with the present frame."""
        self._recording = Recording(self.memories, self._frames)

    def save_recording(self, folder: Path) -> SavedRecording:
        """Write the recording as a video and a data set of a trajectory for each memory; nothing else may go on.

        It stays until ``end_recording``, so that it can be saved elsewhere.

        Raises:
            PersistError: when nothing was recorded, or the folder cannot be written.
        """
        if self._recording is None:
            raise PersistError("nothing was recorded; begin a recording first")
        return self._recording.save(folder, self.info, {"checkpoint": self.model, "start": self._start.name})

    def end_recording(self) -> None:
        """Record no more, and forget what was recorded."""
        self._recording = None

    @property
    def _frames(self) -> tuple[Observations, ...]:
        return tuple(agent.now for agent in self._walkers.agents)

    def _drop(self) -> None:
        """Drop all that is imagined and not shown, and let the planner stop."""
        self._let_go()
        self.stop()
        self._thoughts.clear()

    def _let_go(self) -> None:
        """Drop the rest of the clip, and begin anew with the held actions."""
        self._ahead, self._turn, self._blocked, self._clips = None, 0, 0, 0

    def _next_thought(self) -> tuple[str, ...] | None:
        """Return the likeliest next actions of which nothing is imagined yet: those before, else a single move."""
        if not self.settings.ahead or (self._ahead is not None and self._ahead.left):
            return None
        moves = [action for action in self.actions if action.forward or action.turn]
        moves.sort(key=lambda action: (action.forward < 0, -action.forward))
        singles = [(action.name,) for action in moves]
        before = [self._last] if self._last and all((name,) in singles for name in self._last) else []
        return next((one for one in [*before, *singles] if one not in self._thoughts), None)

    def _imagine(self, actions: tuple[str, ...], number: int) -> Ahead:
        """Return the clip of a number under held actions, counted from 0."""
        self._walkers.set_clip_frames(self._lengths[min(number, len(self._lengths) - 1)])
        return self._walkers.imagine(actions)

    def _clip_lengths(self, settings: PlaySettings) -> tuple[int, ...]:
        """Return the frames of the clips under newly held keys, one after the other; later ones are as the last.

        Raises:
            PersistError: when the model cannot make clips of the settings' length.
        """
        backbone = next(iter(self._walkers.worlds.values())).backbone
        longest = settings.clip_frames or backbone.frames_per_clip
        if longest != backbone.frames_per_clip:
            backbone.check_clip_frames(longest)
        shorter = [frames for frames in GROWTH if frames < longest and backbone.makes_clips(frames)]
        return (*shorter * settings.growing, longest)

    def _take(self, ahead: Ahead, begun: float) -> Shown:
        """Show the next action of a clip."""
        name = ahead.names[ahead.taken]
        free = self._walkers.show(ahead)
        self._thoughts.clear()
        self._blocked = 0 if free else self._blocked + 1
        if free:
            self._surveyor.went(jumped=False)
            self._record(name)
        return self._show(name, free, begun)

    def _jump(self, pose: Pose) -> Shown:
        begun = time.monotonic()
        self._drop()
        self._walkers.set_clip_frames(self._lengths[-1])
        self._walkers.stand_at(self._walkers.look_from(pose))
        self._surveyor.went(jumped=True)
        self._record(None)
        return self._show(None, True, begun)

    def _record(self, action: str | None) -> None:
        if self._recording is not None:
            self._recording.add(action, self._frames)

    def _show(self, action: str | None, free: bool, begun: float) -> Shown:
        """Return the present frames as shown now, and keep them as ``shown``."""
        self._number += 1
        images = {name: frame.rgb[0] for name, frame in zip(self.memories, self._frames, strict=True)}
        pose = GroundPose.of(self._walkers.pose, self.info.world_up)
        milliseconds = 1000 * (time.monotonic() - begun)
        self.shown = Shown(self._number, action, free, pose, images, milliseconds)
        return self.shown

    @staticmethod
    def _sampling(world: WorldModel, settings: PlaySettings) -> Sampling:
        return dataclasses.replace(
            world.sampling, steps=settings.steps, memory_guidance=settings.guidance, autoguidance=settings.autoguidance
        )
