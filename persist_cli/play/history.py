"""The last frames of a walk, so that they can be undone together with what was remembered of them.

Memories cannot forget single frames. They are copied now and then instead. To undo a frame, the last copy is taken up
again and the frames since, but for that one, are written anew, in the same parts. What a scene imagined depends on
dropped clips too, so a scene is copied wherever it has changed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

from persist_cli.api.memory import Memory
from persist_cli.api.observations import Observations
from persist_cli.api.scene import Scene
from persist_cli.rollout.surroundings import Surroundings
from persist_cli.rollout.world_model import Agent

UNDO: Final = 32  # frames from one copy of the memories to the next; so many at least can be undone


@dataclass(frozen=True)
class SceneState:
    """A copy of an agent's scene, and of what the agent knows of the ground if it has a body."""

    scene: Scene
    surroundings: Surroundings | None

    @staticmethod
    def of(agent: Agent) -> SceneState | None:
        """Return the state of an agent, ``None`` without a scene."""
        if agent.scene is None:
            return None
        return SceneState(agent.scene.copy(), agent.surroundings and agent.surroundings.copy())

    def restore(self, agent: Agent) -> None:
        """Bring an agent into this state, which stays as it is."""
        agent.memory, agent.surroundings = self.scene.copy(), self.surroundings and self.surroundings.copy()


@dataclass(frozen=True)
class Step:
    """A frame that was shown.

    Args:
        action: that led to it; ``None`` where none did.
        frames: of each world model.
        clips: number of each agent's clips up to it.
        begins: whether it is the first of a clip; all frames before it were remembered then.
        scenes: of each agent, before the frame; ``None`` where no scene changed since the frame before.
    """

    action: str | None
    frames: tuple[Observations, ...]
    clips: tuple[int, ...]
    begins: bool
    scenes: tuple[SceneState | None, ...]


@dataclass(frozen=True)
class AgentStates:
    """The state of agents at a time when all shown frames are remembered.

    Args:
        frames: the present frame of each.
        clips: number of clips of each.
        memories: copies.
        surroundings: copies; ``None`` for agents without a body.
    """

    frames: tuple[Observations, ...]
    clips: tuple[int, ...]
    memories: tuple[Memory | None, ...]
    surroundings: tuple[Surroundings | None, ...]

    @staticmethod
    def of(agents: Sequence[Agent]) -> AgentStates:
        """Return the state of agents."""
        return AgentStates(
            tuple(agent.now for agent in agents),
            tuple(agent.clips for agent in agents),
            tuple(agent.memory and agent.memory.copy() for agent in agents),
            tuple(agent.surroundings and agent.surroundings.copy() for agent in agents),
        )

    def restore(self, agents: Sequence[Agent]) -> None:
        """Bring agents into this state, which stays as it is."""
        for number, agent in enumerate(agents):
            memory, surroundings = self.memories[number], self.surroundings[number]
            agent.now, agent.clips = self.frames[number], self.clips[number]
            agent.memory = memory and memory.copy()
            agent.surroundings = surroundings and surroundings.copy()


@dataclass
class History:
    """The steps since the last two checkpoints, at most about twice ``UNDO`` and a clip.

    Args:
        start: where the walk begins.
    """

    start: AgentStates
    _parts: list[tuple[AgentStates, list[Step]]] = field(init=False)

    def __post_init__(self) -> None:
        self._parts = [(self.start, [])]

    def add(self, step: Step) -> None:
        """Append a step."""
        self._parts[-1][1].append(step)

    def remembered(self, agents: Sequence[Agent]) -> None:
        """Keep a checkpoint if it is time; to be called when all shown frames are remembered."""
        if len(self._parts[-1][1]) >= UNDO:
            self._parts = [self._parts[-1], (AgentStates.of(agents), [])]

    def undo(self) -> tuple[AgentStates, Sequence[Step]] | None:
        """Forget the last step; return the checkpoint before it and the steps since, ``None`` if there is no step."""
        if not self._parts[-1][1] and len(self._parts) > 1:
            self._parts.pop()
        checkpoint, steps = self._parts[-1]
        if not steps:
            return None
        steps.pop()
        return checkpoint, tuple(steps)
