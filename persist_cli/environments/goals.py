"""Starts and goals in a known house: frames of a data set, places, and free ground; and the metres between them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from persist_cli.api.ground import GroundMap
from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.api.policy import Goal
from persist_cli.data.images import crop_resize
from persist_cli.data.store import TrajectoryFile
from persist_cli.environments.task import TaskSettings
from persist_cli.errors import DataError
from persist_cli.memorize.sources import Source, common_reference, find_sources
from persist_cli.navigation.routes import Distances, distances_to, holding
from persist_cli.output.console import warn

ROOM = 3.0  # metres of unknown ground around all that is known, over which an agent may walk too

UNKNOWN = 1.0  # metres that a metre over unknown ground counts

MOST_KEPT = 64  # goals whose distances are kept

RANDOM: Final = "random"  # the goal of a setting that is free known ground

SEEN: Final = "seen"  # and the one that is free ground which the start frames show

Place = Float[Tensor, " 2"]  # on the ground axes, metres


class PosedFrames:
    """Frames of a data set, whose images are read when they are asked for.

    Args:
        text: the frame ``DATA#0:32``, the frames ``DATA#0:0-33``, or all of a trajectory, ``DATA#0``.

    Raises:
        DataError: when they are not there, or are of several scenes.
    """

    def __init__(self, text: str) -> None:
        self.text = text
        self.sources: list[Source] = find_sources([text])
        common_reference(self.sources)
        self.file: TrajectoryFile = self.sources[0].file
        self.info: TrajectoryInfo = self.file.info
        self._frames = [(source.file, number) for source in self.sources for number in source.frames]
        parts = [source.file.poses()[source.frames.start : source.frames.stop, :3, 3] for source in self.sources]
        self.positions: Float[Tensor, "frame 3"] = torch.cat(parts)

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> Observations:
        file, number = self._frames[index]
        return file.read([number]).observations

    def check_scene(self, scene: str) -> None:
        """Raise ``DataError`` when these frames are of another scene."""
        if self.info.scene != scene:
            raise DataError(f"{self.text}: is of scene {self.info.scene!r}, and the start of {scene!r}; name one scene")


@dataclass(frozen=True)
class Goals:
    """The goals that an episode may have.

    Args:
        positions: of the camera there, world metres.
        scene: name of their scene.
        size: height and width of the agent's images.
        frames: whose images they show, cropped and resized to that; ``None`` where the goals are places alone.
    """

    positions: Float[Tensor, "goal 3"]
    scene: str
    size: tuple[int, int]
    frames: PosedFrames | None = None

    def goal(self, index: int) -> Goal:
        """Return one of the goals."""
        rgb = None
        if self.frames is not None:
            image = self.frames[index].rgb[0].numpy()
            same = image.shape[:2] == self.size
            rgb = torch.from_numpy(image if same else crop_resize(image.shape[:2], self.size).rgb(image))
        return Goal(rgb, self.positions[index].double(), self.scene)


def find_goals(wanted: str | Sequence[float], free: Goals, observe: str) -> Goals:
    """Return the goals of a setting: frames of a data set, a place in world metres, or free ground.

    Args:
        wanted: the setting.
        free: the goals that ``random`` or ``seen`` stands for.
        observe: ``image`` where goals must have one.

    Raises:
        DataError: when they are not there, of another scene, or places where images are wanted.
    """
    if isinstance(wanted, str) and Path(wanted).is_file():
        raise DataError(
            f"{wanted}: an image does not say where it was taken, from which the reward is measured; name a frame of a "
            "data set, as in runs/houses#0:40"
        )
    anywhere = wanted in (RANDOM, SEEN)
    if isinstance(wanted, str) and not anywhere:
        frames = PosedFrames(wanted)
        frames.check_scene(free.scene)
        info, (height, width) = frames.info, free.size
        if (info.height, info.width) != free.size:
            warn(f"goal {wanted}: resized from {info.height}x{info.width} to {height}x{width} pixels")
        return replace(free, positions=frames.positions, frames=frames)
    if observe == "image":
        raise DataError(f"goal {wanted!r}: a place has no image; give observe_goal='place', or a frame of a data set")
    if anywhere:
        if not len(free.positions):
            raise DataError(
                f"goal {wanted!r}: no free ground is known; name frames of a data set, or give collide=True where the "
                "camera is some 1.25 m above the floor"
            )
        return free
    return replace(free, positions=torch.tensor([list(wanted)], dtype=torch.float64))


class KnownGround:
    """The metres between places of a house, over what is known of its ground when an episode begins.

    Unknown ground counts as free. What an agent imagines later changes nothing, so that its rewards sum to the metres
    that it came nearer.

    Args:
        ground: what is known.
        radius: metres of the agent's body.
        task: says whether metres are straight.
    """

    def __init__(self, ground: GroundMap, radius: float, task: TaskSettings) -> None:
        self.ground, self.radius, self.task = ground, radius, task
        self._kept: dict[tuple[float, ...], Distances] = {}

    def metres(self, positions: Float[Tensor, "place 3"], goal: Float[Tensor, " 3"]) -> Float[Tensor, " place"]:
        """Return the metres from world positions to a goal, float64; always finite.

        They are straight where the task says so, and where the goal is inside something to which no ground leads. From
        a place without a way, such as one that walls enclose, they are straight to ground from which a way leads.
        """
        places, there = self.ground.places(positions), self.ground.places(goal)
        distances = None if self.task.distance == "straight" else self._distances(there)
        if distances is None or not bool(distances.metres.isfinite().any()):
            return torch.linalg.vector_norm(places - there, dim=1)  # type: ignore[no-any-return]
        metres = distances.at(places)
        for number in metres.isinf().nonzero()[:, 0].tolist():
            metres[number] = nearest_way(distances, places[number])
        return metres

    def free_places(self, starts: Float[Tensor, "start 3"]) -> Float[Tensor, "place 3"]:
        """Return world positions over all known free ground that can be reached from the starts, at their height."""
        places = self.ground.places(starts)
        reached = distances_to(self.ground, places, self.radius)
        squares = reached.metres.isfinite().nonzero()
        middles = (squares.flip(1) + 0.5) * self.ground.spacing + torch.tensor(self.ground.origin).double()
        height = (starts.double() @ self.ground.axes[2]).mean().expand(len(middles), 1)
        return torch.cat([middles, height], dim=1) @ self.ground.axes

    def can_reach(
        self, positions: Float[Tensor, "place 3"], starts: Float[Tensor, "start 3"]
    ) -> Bool[Tensor, " place"]:
        """Whether known free ground leads from any start to world positions."""
        reached = distances_to(self.ground, self.ground.places(starts), self.radius)
        return reached.at(self.ground.places(positions)).isfinite()

    def _distances(self, there: Place) -> Distances:
        key = tuple(there.tolist())
        if key not in self._kept:
            if len(self._kept) >= MOST_KEPT:
                self._kept.pop(next(iter(self._kept)))
            wide = holding(self.ground, there[None], ROOM)
            self._kept[key] = distances_to(wide, there[None], self.radius, UNKNOWN)
        return self._kept[key]


def nearest_way(distances: Distances, place: Place) -> float:
    """Return the metres from a place without a way: straight to where they are least in all, and on from there."""
    squares = distances.metres.isfinite().nonzero()
    if not len(squares):
        return math.inf
    ground = distances.ground
    middles = (squares.flip(1) + 0.5) * ground.spacing + torch.tensor(ground.origin).double()
    return float(((middles - place).norm(dim=1) + distances.metres[squares[:, 0], squares[:, 1]]).min())
