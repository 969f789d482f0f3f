"""One episode of one row: the open loop makes a plan; the closed loop acts, looks and plans again."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import torch

from persist_cli.api.actions import format_actions
from persist_cli.api.observations import Observations
from persist_cli.episodes.navigation_metrics import (
    WalkRecord,
    absolute_error,
    closed_loop_figures,
    relative_error,
    similarity,
    way_metres,
)
from persist_cli.episodes.navigator import Decision, Navigator
from persist_cli.episodes.stop_rules import StopRule
from persist_cli.episodes.true_scene import TrueScene
from persist_cli.errors import PersistError
from persist_cli.metrics.networks import missing_weights
from persist_cli.metrics.src import ENCODERS, VideoFeatures

OUT_OF_ACTIONS: Final = "out of actions"


@dataclass(frozen=True)
class LoopSettings:
    """How episodes are run.

    Args:
        execute: actions that the closed loop does before it plans again.
        patience: most actions of the closed loop, as a multiple of those of the shortest way.
        open_longest: longest bin of the open loop, in actions.
        max_actions: most actions of every closed loop, as the 500 or 1,000 of Habitat, in place of ``patience``.
    """

    execute: int = 4
    patience: float = 4.0
    open_longest: int = 16
    max_actions: int | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.patience < math.inf:
            raise PersistError(f"--patience {self.patience:g}: give a number from 1 on; it must be finite")
        if self.max_actions is not None and self.patience != type(self).patience:
            raise PersistError(f"--patience {self.patience:g}, --max-actions {self.max_actions}: give one of the two")

    def most(self, shortest: int) -> int:
        """Return the most actions of a closed loop whose shortest way has ``shortest`` actions."""
        return math.ceil(self.patience * shortest) if self.max_actions is None else self.max_actions


@dataclass
class Trace:
    """What happened in a closed loop so far."""

    distances: list[float]
    places: list[tuple[float, float]]
    actions: list[str] = field(default_factory=list)
    refused: list[int] = field(default_factory=list)  # numbers of the actions that the scene refused
    decisions: int = 0
    frames: int = 0  # imagined
    seconds: float = 0.0  # of deciding

    def add(self, decision: Decision) -> None:
        """Count a decision."""
        self.decisions += 1
        self.frames, self.seconds = self.frames + decision.frames, self.seconds + decision.seconds

    def to_json(self, ended: str, figures: dict[str, float], writing: float) -> dict[str, Any]:
        """Return the trace with its figures as JSON values; ``writing`` are the seconds of taking in what was seen."""
        decisions = max(self.decisions, 1)
        figures |= {
            "decisions": float(self.decisions), "frames_per_decision": self.frames / decisions,
            "seconds_per_decision": self.seconds / decisions, "writing_per_decision": writing / decisions,
        }  # fmt: skip
        return {
            "figures": figures, "ended": ended, "actions": format_actions(self.actions), "refused": self.refused,
            "places": [[round(value, 4) for value in place] for place in self.places],
        }  # fmt: skip


@dataclass
class ClosedLoop:
    """An agent that acts, looks and decides again, until it stops or has no actions left.

    Args:
        scene: with the agent at the start.
        navigator: of an agent that was given what its row is given.
        stop: rule of the row.
        settings: of the loop.
        trace: what happened so far.
    """

    scene: TrueScene
    navigator: Navigator
    stop: StopRule
    settings: LoopSettings
    trace: Trace

    def run(self) -> str:
        """Run it to its end, and return how it ended: ``stopped``, ``gave no action`` or ``out of actions``."""
        recognised = self._recognises(self.navigator.seen[-1:])
        while self.left:
            if recognised and not self.navigator.approaches:
                return "stopped"
            decision = self.navigator.approach() if recognised else self.navigator.decide()
            self.trace.add(decision)
            if not decision.actions:
                return "stopped" if recognised else "gave no action"
            recognised = self._act(decision.actions, recognised)
        return "stopped" if recognised else OUT_OF_ACTIONS

    @property
    def left(self) -> int:
        """Number of actions that the agent still has."""
        return self.settings.most(self.scene.episode.bin) - len(self.trace.actions)

    def _recognises(self, view: Observations) -> bool:
        return self.stop.stops(view, self.navigator.goal, self.scene.info.world_up)

    def _act(self, actions: Sequence[str], approaching: bool) -> bool:
        """Do the first actions of a plan until the goal is recognised, or all of an approach; return whether it is."""
        count = self.left if approaching else min(self.settings.execute, self.left)
        frames, recognised = list[Observations](), False
        for action in actions[:count]:
            frames.append(self._do(action))
            recognised = self._recognises(frames[-1])
            if recognised and not approaching:
                break
        self.navigator.saw(Observations.concatenate(frames), len(frames))
        return recognised

    def _do(self, action: str) -> Observations:
        """Do an action and return the frame after it; the agent notices when something is in the way."""
        allowed, trace = self.scene.simulator.act(action), self.trace
        if not allowed:
            trace.refused.append(len(trace.actions))
        trace.actions.append(action)
        trace.places.append(self.scene.simulator.agent[0])
        trace.distances.append(self.scene.distance)
        frame = self.scene.look()
        if not allowed:
            self.navigator.collided(frame, action)
        return frame


def run_closed_loop(scene: TrueScene, navigator: Navigator, stop: StopRule, settings: LoopSettings) -> dict[str, Any]:
    """Let an agent act until it stops or has no actions left, and return what happened as JSON values.

    After each action the agent looks. Where its stop rule recognises the goal it stops, or first approaches the best
    view of it; it also stops when it decides to do nothing.

    Args:
        scene: with the agent at the start.
        navigator: of an agent that was given what its row is given.
        stop: rule of the row.
        settings: of the loop.
    """
    trace = Trace([scene.distance], [scene.simulator.agent[0]])
    ended = ClosedLoop(scene, navigator, stop, settings, trace).run()
    walk = WalkRecord(trace.distances, way_metres(trace.places), len(trace.refused), ended != OUT_OF_ACTIONS)
    return trace.to_json(ended, closed_loop_figures(walk, scene.episode.metres), navigator.writing)


def run_open_loop(scene: TrueScene, navigator: Navigator) -> dict[str, Any]:
    """Make one plan as long as the shortest way, follow it in the true scene, and return its figures as JSON values.

    The agent is back at the start afterwards.
    """
    decision = navigator.decide()
    true = scene.shortest_way()
    frames, allowed = scene.follow(decision.actions[: scene.episode.bin])
    scene.back_to_start()
    poses = frames.cameras.world_from_camera
    poses = torch.cat([poses, poses[-1:].expand(len(true) - len(poses), 4, 4)])  # who has stopped stays
    return {
        "actions": format_actions(decision.actions),
        "figures": {
            "ate": absolute_error(poses, true.cameras.world_from_camera),
            "rpe": relative_error(poses, true.cameras.world_from_camera),
            "open_collisions": float(len(allowed) - sum(allowed)),
            "open_frames": float(decision.frames),
            "open_seconds": decision.seconds,
        }
        | view_figures(frames[-1:], scene.goal_view),
    }


def view_figures(view: Observations, goal: Observations) -> dict[str, float]:
    """Return SIM and LPIPS of the view at the end of a plan and the goal image; without those whose weights miss."""
    from persist_cli.metrics.lpips import ALEX, LpipsAlex, perceptual_distance, tensor_shapes
    from persist_cli.metrics.networks import network_weights, run_network

    figures = {}
    if missing_weights(*(encoder.name for encoder in ENCODERS)) is None:
        seen, wanted = (VideoFeatures(frame.rgb).encode(0) for frame in (view, goal))
        figures["sim"] = similarity(seen, wanted)
    least = min(view.rgb.shape[1:3])
    if missing_weights(LpipsAlex.name) is None and least >= LpipsAlex.least_size:
        weights = network_weights(LpipsAlex.name, tensor_shapes(ALEX))
        distance = run_network(lambda a, b: perceptual_distance(weights, ALEX, a, b), view.rgb, goal.rgb)
        figures["lpips"] = float(distance[0])
    return figures
