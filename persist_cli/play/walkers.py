"""One walk in several world models: each imagines the same poses with a memory of its own.

Frames are imagined a clip at a time and shown one by one. What is not shown yet is in no memory and moves no agent, so
that it can be dropped when other keys are held. What was shown is remembered before the next clip is imagined.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from persist_cli.api.backbone import Backbone, Clips, Interactions, Sampling
from persist_cli.api.cameras import Cameras
from persist_cli.api.cells import CellGrid
from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.data.clips import interactions_of
from persist_cli.play.history import AgentStates, History, SceneState, Step
from persist_cli.rollout.surroundings import plan_walks
from persist_cli.rollout.world_model import Agent, WorldModel

Pose = Float[Tensor, "4 4"]


class AdaptedWorld(WorldModel):
    """A world model that shares its backbone with others, each of which reads another memory by an adapter of its own.

    Args:
        backbone: has all of the adapters.
        agents: one agent for each rollout.
        sampling: steps, sampler and guidance of each clip.
        adapter: name of the adapter; ``None`` for the model without one.
    """

    def __init__(self, backbone: Backbone, agents: Sequence[Agent], sampling: Sampling, adapter: str | None) -> None:
        super().__init__(backbone, agents, sampling)
        self.adapter = adapter

    def recall(self, moving: Sequence[int], ways: Sequence[Cameras], interactions: Sequence[Interactions]) -> Clips:
        """Let the backbone use the adapter, and return the clips that it shall predict."""
        self.backbone.use_adapter(self.adapter)
        return super().recall(moving, ways, interactions)


@dataclass
class Ahead:
    """A clip that was imagined, of which some frames may not be shown yet.

    Args:
        names: of the actions of the clip, the blocked ones too.
        free: whether the way of each was free.
        seen: for each world model the frames of the free ones.
    """

    names: Sequence[str]
    free: Sequence[bool]
    seen: Sequence[Observations]
    taken: int = field(default=0, init=False)  # actions that were shown

    @property
    def left(self) -> bool:
        """Whether a frame is left to show."""
        return self.taken < len(self.names)


class Walkers:
    """The agents of several world models, which all stand at one pose.

    Only the first one has a body and can be blocked; what it finds counts for all.

    Args:
        worlds: world models of one agent each, by the name of their memory; the agents have not begun.
    """

    def __init__(self, worlds: Mapping[str, WorldModel]) -> None:
        self.worlds = dict(worlds)
        self._start = [world.agents[0].memory for world in worlds.values()]
        self._shown: list[list[Observations]] = [[] for _ in worlds]  # of each world, not remembered yet
        self._history: History
        self._cells: list[CellGrid | None]  # of the agents' scenes when the last step was kept
        self.version = 0  # grows with every change of the memories and of what is known of the ground

    @property
    def agents(self) -> list[Agent]:
        """The agent of each world model."""
        return [world.agents[0] for world in self.worlds.values()]

    @property
    def lead(self) -> Agent:
        """The agent of the first world model, which decides what is blocked."""
        return self.agents[0]

    @property
    def info(self) -> TrajectoryInfo:
        """Scene, up axis and vocabulary."""
        return self.lead.info

    @property
    def pose(self) -> Pose:
        """World from camera of all agents."""
        return self.lead.now.cameras.world_from_camera[0]

    @property
    def longest(self) -> int:
        """The number of frames that a clip shows."""
        return next(iter(self.worlds.values())).clip_frames - 1

    def begin(self, start: Observations, info: TrajectoryInfo) -> None:
        """Let all agents stand at an observed frame, and remember it beside what they remembered at first."""
        for world, memory in zip(self.worlds.values(), self._start, strict=True):
            world.agents[0].memory = memory and memory.copy()
            world.reset([start], [info])
        self._shown = [[] for _ in self.worlds]
        self._history = History(AgentStates.of(self.agents))
        self._cells = self._present_cells()
        self.version += 1

    def begin_here(self) -> None:
        """Remember what was shown, and let no undo go back behind the present frame."""
        self.remember()
        self._history = History(AgentStates.of(self.agents))

    def set_clip_frames(self, frames: int) -> None:
        """Let the next clips have so many frames, the present one included.

        Raises:
            PersistError: when the model cannot make such clips; then they stay as they were.
        """
        for world in self.worlds.values():
            world.clip_frames = frames  # all share one model, so that none or the first one refuses

    def imagine(self, actions: Sequence[str], repeat: bool = True) -> Ahead:
        """Return a clip of some actions in turn; nothing of it is shown yet.

        In a scene an interaction is done here. It is the only action of its clip. A scene also imagines here the cells
        that the clip will see, and keeps them where the clip is dropped: they are what its seed makes of them.

        Args:
            actions: names in the vocabulary; an interaction is done alone, and once.
            repeat: whether they are repeated until the clip is full.
        """
        self.remember()
        once = self.info.vocabulary[actions[0]].interaction
        turns = itertools.cycle(actions) if repeat else actions
        names = tuple(actions[:1]) if once else tuple(itertools.islice(turns, self.longest))
        walk = self.lead.set_out(names, self.longest)
        plan_walks([walk], [names[len(walk.names) :]], self.longest)
        if once and walk.free[0]:
            self._interact(names[0], self.agents[1:])
        seen = [agent.now[:0] for agent in self.agents]
        if walk.poses:
            seen = self._predict(walk.cameras, interactions_of(walk.moves, self.info.vocabulary))
        return Ahead(walk.names, walk.free, seen)

    def look_from(self, pose: Pose) -> list[Observations]:
        """Return for each world model a single frame from a pose that no action leads to; nothing is shown yet.

        A clip that stands still there is imagined, and its last frame is taken.
        """
        self.remember()
        cameras = self.lead.now.cameras.at(pose[None].double().expand(self.longest, 4, 4))
        return [seen[-1:] for seen in self._predict(cameras, (None,) * self.longest)]

    def show(self, ahead: Ahead) -> bool:
        """Let the agents take the next action of a clip, and return whether its way is free.

        What the frames before showed counts too: a wall that only the clip itself shows stops the agents, and the rest
        of the clip is dropped.
        """
        free, frame = ahead.free[ahead.taken], sum(ahead.free[: ahead.taken])
        ahead.taken += 1
        if not free:
            return False
        frames = [seen[frame : frame + 1] for seen in ahead.seen]
        walks = self.info.vocabulary[ahead.names[ahead.taken - 1]].forward
        known = self.lead.surroundings
        there = frames[0].cameras.world_from_camera[0]
        if frame and walks and known is not None and known.blocks(self.pose, there):
            ahead.taken = len(ahead.names)
            return False
        self.stand_at(frames, ahead.names[ahead.taken - 1], begins=frame == 0)
        return True

    def stand_at(self, frames: Sequence[Observations], action: str | None = None, begins: bool = True) -> None:
        """Make a frame of each world model the present one, to be remembered.

        Args:
            frames: one of each.
            action: that led there.
            begins: whether it is the first of a clip.
        """
        clips = tuple(agent.clips + begins for agent in self.agents)
        step = Step(action, tuple(frames), clips, begins, self._changed_scenes())
        self._take(step)
        self._history.add(step)

    def undo(self) -> bool:
        """Go back to the frame before the present one, also in the memories; false where there is none to undo."""
        last = self._history.undo()
        if last is None:
            return False
        checkpoint, steps = last
        checkpoint.restore(self.agents)
        self._shown = [[] for _ in self.worlds]
        self.version += 1
        for step in steps:
            if step.begins:
                self._write()
            for agent, state in zip(self.agents, step.scenes, strict=True):
                if state is not None:
                    state.restore(agent)
            self._take(step)
        self._cells = self._present_cells()
        return True

    def remember(self) -> None:
        """Write what was shown into the memories."""
        self._write()
        self._history.remembered(self.agents)

    def _present_cells(self) -> list[CellGrid | None]:
        return [None if agent.scene is None else agent.scene.cells for agent in self.agents]

    def _changed_scenes(self) -> tuple[SceneState | None, ...]:
        """Return the states of the agents whose scenes changed since the last call or undo."""
        before, self._cells = self._cells, self._present_cells()
        pairs = zip(self.agents, before, self._cells, strict=True)
        return tuple(None if cells is old else SceneState.of(agent) for agent, old, cells in pairs)

    def _take(self, step: Step) -> None:
        """Let the agents stand at the frames of a step."""
        for agent, frame, clips, shown in zip(self.agents, step.frames, step.clips, self._shown, strict=True):
            agent.notice(frame)
            agent.stand_at(frame)
            agent.clips = clips
            shown.append(frame)
        self.version += 1

    def _write(self) -> None:
        for world, agent, shown in zip(self.worlds.values(), self.agents, self._shown, strict=True):
            if shown:
                agent.memorize(Observations.concatenate(shown), world.backbone.device)
                shown.clear()
                agent.reads.clear()  # of figures that nobody asks for here

    @staticmethod
    def _interact(action: str, agents: Sequence[Agent]) -> None:
        """Let an interaction change the scenes of agents."""
        for agent in agents:
            if agent.scene is not None:
                agent.interact(action)

    def _predict(self, cameras: Cameras, interactions: Interactions) -> list[Observations]:
        with torch.no_grad():
            return [world.predict([0], [cameras], [interactions])[0] for world in self.worlds.values()]
