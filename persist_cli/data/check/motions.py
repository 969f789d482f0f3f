"""Do cameras move as their actions say? Turns the other way round show an up axis that points down.

For example ``left`` turns 15° to the left, as its vocabulary says. Between nearly all frames that take it, the camera
turned 15° to the right about the stored ``world_up``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from persist_cli.api.actions import FREE, Action
from persist_cli.data.store import TrajectoryFile

OFF = 0.5  # of the motion that an action has, from which on the camera's is another one
STILL = 0.1  # of it, below which the camera was stopped by something
LEAST_TAKEN = 3  # motions of an action, of fewer nothing is said
LEAST_LEVEL = 0.1  # of a unit view direction that must lie on the ground, else nothing is ahead


@dataclass(frozen=True)
class Motions:
    """What cameras did at the frames that take an action.

    Args:
        action: the action.
        ahead: metres along the heading on the ground.
        aside: metres on the ground to the side of it.
        turn: degrees to the left about the up axis, above -180 and up to 180.
    """

    action: Action
    ahead: Float[Tensor, " motion"]
    aside: Float[Tensor, " motion"]
    turn: Float[Tensor, " motion"]

    @property
    def moved(self) -> Bool[Tensor, " motion"]:
        """Which of them are motions at all: not those of an agent that was stopped."""
        step, turn = self.action.forward, self.action.turn
        walked = torch.hypot(self.ahead, self.aside) > STILL * abs(step)
        return (walked & (step != 0)) | ((self.turn.abs() > STILL * abs(turn)) & (turn != 0))

    @property
    def other(self) -> Bool[Tensor, " motion"]:
        """Which of them are clearly another motion than the action's."""
        step, turn = self.action.forward, self.action.turn
        walked = torch.hypot(self.ahead - step, self.aside) > OFF * abs(step)
        turned = _wrapped(self.turn - turn).abs() > OFF * abs(turn)
        return self.moved & ((walked & (step != 0)) | (turned & (turn != 0)))


def wrong_motions(files: Sequence[TrajectoryFile], frames: slice | None = None) -> list[str]:
    """One line for each action at most of whose frames the camera clearly moves otherwise than the action says.

    Args:
        files: the trajectories; their actions may be of other sizes in each.
        frames: those that are looked at, ``None`` for all.
    """
    motions: dict[str, list[Motions]] = {}
    for file in files:
        for one in trajectory_motions(file, frames):
            motions.setdefault(one.action.name, []).append(one)
    lines = []
    for name, parts in motions.items():
        other = sum(int(part.other.sum()) for part in parts)
        moved = sum(int(part.moved.sum()) for part in parts)
        if moved >= LEAST_TAKEN and other > moved / 2:
            worst = max(parts, key=lambda part: int(part.other.sum()))
            lines.append(f"{other} of {moved} motions by {name} are not what its vocabulary says: {_comparison(worst)}")
    return lines


def trajectory_motions(file: TrajectoryFile, frames: slice | None = None) -> list[Motions]:
    """The motions of each action of a trajectory that moves the camera, read from poses and actions alone."""
    numbers = torch.tensor(file.frame_numbers(frames or slice(None)))
    poses, names, info = file.poses()[numbers], file.actions(), file.info
    up = torch.tensor(info.world_up, dtype=torch.float64)
    up = up / up.norm()
    taken = [names[number] for number in numbers[:-1]]
    found = []
    for action in info.vocabulary.actions:
        chosen = torch.tensor([name == action.name for name in taken], dtype=torch.bool)
        if action.name != FREE and (action.forward or action.turn) and chosen.any():
            found.append(Motions(action, *_motions(poses[:-1][chosen], poses[1:][chosen], up)))
    return found


def _motions(
    before: Float[Tensor, "motion 4 4"], after: Float[Tensor, "motion 4 4"], up: Float[Tensor, " 3"]
) -> tuple[Float[Tensor, " motion"], Float[Tensor, " motion"], Float[Tensor, " motion"]]:
    """Metres ahead, metres aside, and degrees to the left; only of motions of cameras that look along the ground."""
    view = before[:, :3, 2]
    level = view - (view @ up)[:, None] * up
    seen = level.norm(dim=1) > LEAST_LEVEL
    before, after, level = before[seen], after[seen], level[seen]
    way = after[:, :3, 3] - before[:, :3, 3]
    way = way - (way @ up)[:, None] * up  # stairs lead up and down
    heading = level / level.norm(dim=1, keepdim=True)
    ahead = (way * heading).sum(1)
    aside = (way - ahead[:, None] * heading).norm(dim=1)
    turned = after[:, :3, :3] @ before[:, :3, :3].transpose(1, 2)
    cross = torch.stack([turned[:, 2, 1] - turned[:, 1, 2], turned[:, 0, 2] - turned[:, 2, 0],
                         turned[:, 1, 0] - turned[:, 0, 1]], dim=1) / 2  # fmt: skip  # the axis times the sine
    cosine = (turned.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2
    return ahead, aside, torch.rad2deg(torch.atan2(cross @ up, cosine))


def _comparison(motions: Motions) -> str:
    """What the camera does, in the middle of its other motions, what the action says, and the likely cause."""
    action, other = motions.action, motions.other
    ahead, aside, turn = (float(part[other].median()) for part in (motions.ahead, motions.aside, motions.turn))
    did = []
    if action.forward:
        did.append(f"goes {math.hypot(ahead, aside):.3g} m, {math.degrees(math.atan2(aside, ahead)):.0f}° from ahead")
    if action.turn:
        did.append(f"turns {abs(turn):.3g}° to the {'left' if turn > 0 else 'right'}")
    mirrored = action.turn and abs(turn + action.turn) <= OFF * abs(action.turn)
    cause = "world_up points down, or left and right are swapped" if mirrored else "poses or sizes of steps are wrong"
    return f"the camera {' and '.join(did)}, and it says: {action.effect}; {cause}"


def _wrapped(degrees: Float[Tensor, " motion"]) -> Float[Tensor, " motion"]:
    """The same angles between -180° and 180°."""
    return (degrees + 180) % 360 - 180
