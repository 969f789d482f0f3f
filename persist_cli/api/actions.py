"""Actions: a named vocabulary with units; each action is a relative camera pose or an interaction."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from persist_cli.errors import DataError, nearest_name

FREE = "free"  # a motion that no named action describes; only the poses of the trajectory describe it
STAY = "stay"
WALK = ("stay", "forward", "backward", "left", "right")  # the actions that move a camera over the ground
STEP = 0.25  # metres of a step where nobody says another
LONGEST_STEP = 10.0  # metres of a step that somebody gives; more are meant as millimetres, or take hours to check
TURN = 15.0  # degrees of a turn
MOST_ACTIONS = 1_000_000  # that one word may stand for
WORD = re.compile(r"^(?P<name>[a-z_]+)(?:\*(?P<count>\d+))?$")


@dataclass(frozen=True)
class Action:
    """One action of an agent that walks on the ground.

    Args:
        name: lower-case letters and underscores, as in ``"pick_up"``.
        forward: metres along the camera's heading on the ground; negative values go backward.
        turn: degrees about the world's up axis; positive values turn left.
        reverse: name of the action that undoes it, ``None`` when there is none.
        interaction: whether it changes the world rather than the camera (pick up, drop, toggle).
    """

    name: str
    forward: float = 0.0
    turn: float = 0.0
    reverse: str | None = None
    interaction: bool = False

    @property
    def effect(self) -> str:
        """What it does, in words such as ``"0.25 m ahead"`` or ``"turns 15° to the left"``."""
        if self.name == FREE:
            return "any motion, which only the recorded poses tell"
        motions = []
        if self.forward:
            motions.append(f"{abs(self.forward):g} m {'ahead' if self.forward > 0 else 'back'}")
        if self.turn:
            motions.append(f"turns {abs(self.turn):g}° to the {'left' if self.turn > 0 else 'right'}")
        if self.interaction:
            motions.append("acts on what is there")
        return ", then ".join(motions) or "stays in place"


@dataclass(frozen=True)
class ActionVocabulary:
    """The actions of one data set or agent, in a fixed order; ``vocabulary[name]`` raises ``DataError`` if unknown."""

    actions: tuple[Action, ...]

    def __getitem__(self, name: str) -> Action:
        for action in self.actions:
            if action.name == name:
                return action
        nearest = nearest_name(str(name), self.names)
        meant = f"did you mean {nearest!r}? " if nearest else ""
        raise DataError(f"unknown action {name!r}; {meant}known: {self.listing()}")

    @property
    def names(self) -> tuple[str, ...]:
        """The name of each action."""
        return tuple(action.name for action in self.actions)

    @property
    def can_walk(self) -> bool:
        """Whether any action has a motion of its own, so that a camera can be moved by names."""
        return any(action.forward or action.turn for action in self.actions)

    @property
    def moving(self) -> tuple[Action, ...]:
        """The actions that walk ahead or turn on the spot, which plans and policies choose from."""
        return tuple(action for action in self.actions if action.forward > 0 or (action.turn and not action.forward))

    def listing(self) -> str:
        """Return all actions in one line, as in ``"forward (0.25 m ahead), left (turns 15° to the left)"``."""
        return ", ".join(f"{action.name} ({action.effect})" for action in self.actions) or "none"

    def walking(self, step: float | None = None, turn: float | None = None) -> ActionVocabulary:
        """Return these actions and those of ``WALK``, the latter with steps and turns of a size, added or replaced.

        Args:
            step: metres; ``None`` for those of the own ``forward``, else 0.25.
            turn: degrees; ``None`` for those of the own ``left``, else 15.

        Raises:
            DataError: when the step is not positive and finite, or given as more than 10 metres, or the turn is not
                above 0 and at most 180.
        """
        own = {action.name: action for action in self.actions}
        if step is not None and step > LONGEST_STEP:
            raise DataError(f"a step of {step:g} m; give --step in metres, {LONGEST_STEP:g} at most")
        step = step if step is not None else own["forward"].forward if "forward" in own else STEP
        turn = turn if turn is not None else own["left"].turn if "left" in own else TURN
        if not 0 < step < math.inf or not 0 < turn <= 180:
            raise DataError(f"a step of {step:g} m and a turn of {turn:g}°; give --step above 0 and --turn up to 180")
        walk = {name: action for name, action in own.items() if name not in WALK}
        walk |= {action.name: action for action in walking_actions(step, turn).actions if action.name in WALK}
        return ActionVocabulary(tuple(walk.values()))

    def parse(self, text: str) -> tuple[str, ...]:
        """Return the action names of a text such as ``"forward*4 left"``; ``DataError`` when it cannot be read."""
        names: list[str] = []
        for word in text.split():
            match = WORD.match(word)
            if match is None:
                lower = WORD.match(word.lower())
                advice = (
                    f"write it in lower case: {word.lower()}" if lower else "write NAME or NAME*COUNT, as in left*2"
                )
                raise DataError(f"cannot read action {word!r}; {advice}")
            count = int(match["count"] or 1)
            if count > MOST_ACTIONS:
                raise DataError(f"{word}: at most {MOST_ACTIONS:,} times; longer ways are several rollouts")
            names += [self[match["name"]].name] * count
        if not names:
            raise DataError("no action given; write them as 'forward*4 left*2'")
        return tuple(names)

    def reversed(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return the actions that lead back, the last one's reverse first; ``DataError`` when one has no reverse."""
        reverses = []
        for name in reversed(names):
            reverse = self[name].reverse
            if reverse is None:
                raise DataError(f"action {name!r} has no reverse")
            reverses.append(reverse)
        return tuple(reverses)

    def motion(self, name: str) -> Action:
        """Return an action that says how it moves; ``DataError`` for an unknown one and for ``free``."""
        if name == FREE:
            raise DataError("the action 'free' has no motion of its own; follow the trajectory's poses instead")
        return self[name]

    def move(
        self, world_from_camera: Float[Tensor, "4 4"], name: str, world_up: Float[Tensor, " 3"]
    ) -> Float[Tensor, "4 4"]:
        """Return the camera's pose after an action: it walks along its heading, then turns about the up axis.

        Args:
            world_from_camera: pose before the action, metres, OpenCV axes; the returned pose is float64.
            name: name of the action.
            world_up: vector of any length that points up in the world.

        Raises:
            DataError: for an unknown action and for ``free``, which has no motion of its own.
        """
        action = self.motion(name)
        pose = world_from_camera.double().clone()
        up = world_up.double() / world_up.double().norm()
        heading = pose[:3, 2] - up * (up @ pose[:3, 2])
        if action.forward:
            pose[:3, 3] += action.forward * heading / heading.norm().clamp_min(1e-9)
        pose[:3, :3] = rotation_about(up, math.radians(action.turn)) @ pose[:3, :3]
        return pose

    def follow(
        self, world_from_camera: Float[Tensor, "4 4"], names: Sequence[str], world_up: Float[Tensor, " 3"]
    ) -> Float[Tensor, "frame 4 4"]:
        """Return the pose after each of the actions, the start not included; arguments and errors as in ``move``."""
        poses = []
        for name in names:
            world_from_camera = self.move(world_from_camera, name, world_up)
            poses.append(world_from_camera)
        return torch.stack(poses)

    def to_json(self) -> list[dict[str, Any]]:
        """Return a list of JSON objects that ``from_json`` reads back."""
        return [vars(action).copy() for action in self.actions]

    @staticmethod
    def from_json(rows: list[dict[str, Any]]) -> ActionVocabulary:
        """Return the vocabulary that ``to_json`` wrote."""
        return ActionVocabulary(tuple(Action(**row) for row in rows))


def format_actions(names: Sequence[str]) -> str:
    """Return action names as the text that ``ActionVocabulary.parse`` reads, as in ``"forward*4 left*2"``."""
    runs: list[list[Any]] = []
    for name in names:
        if runs and runs[-1][0] == name:
            runs[-1][1] += 1
        else:
            runs.append([name, 1])
    return " ".join(name if count == 1 else f"{name}*{count}" for name, count in runs)


def walking_actions(step: float = STEP, turn: float = TURN) -> ActionVocabulary:
    """Return the usual vocabulary of an embodied agent: steps of ``step`` metres, turns of ``turn`` degrees."""
    return ActionVocabulary(
        (
            Action(STAY, reverse=STAY),
            Action("forward", forward=step, reverse="backward"),
            Action("backward", forward=-step, reverse="forward"),
            Action("left", turn=turn, reverse="right"),
            Action("right", turn=-turn, reverse="left"),
            Action("pick_up", interaction=True, reverse="drop"),
            Action("drop", interaction=True, reverse="pick_up"),
            Action("toggle", interaction=True, reverse="toggle"),
        )
    )


def free_motion() -> ActionVocabulary:
    """Return the vocabulary of captures whose motion has no names: ``free`` alone."""
    return ActionVocabulary((Action(FREE),))


def rotation_about(axis: Float[Tensor, " 3"], angle: float) -> Float[Tensor, "3 3"]:
    """Return the right-handed rotation by ``angle`` radians about a unit axis, float64 (Rodrigues' formula)."""
    x, y, z = (float(value) for value in axis)
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    return torch.eye(3, dtype=torch.float64) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
