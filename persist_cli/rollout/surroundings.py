"""What an imagined agent knows of the ground around it, and which of its actions are blocked there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.cells import CellGrid
from persist_cli.api.ground import Body, Cover, GroundMap
from persist_cli.api.memory import Memory
from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.api.scene import Scene
from persist_cli.navigation.ground_mapper import GroundMapper
from persist_cli.navigation.ways import way_is_free

Pose = Float[Tensor, "4 4"]


class KnownSurroundings(Protocol):
    """What says where a body can go."""

    @property
    def body(self) -> Body:
        """The body."""
        ...

    def map(self) -> GroundMap:
        """Return the map of the ground as it is known now."""
        ...


@dataclass(frozen=True)
class FixedSurroundings:
    """Surroundings of which nothing more is learned, as for candidates that are only compared.

    Args:
        body: of the agent.
        ground: what is known.
    """

    body: Body
    ground: GroundMap

    def map(self) -> GroundMap:
        """Return the map."""
        return self.ground


class Surroundings:
    """The map of the ground that one agent knows: what its memory held at first, and what it saw and imagined since.

    Frames wait until the map is asked for, since an agent that only imagines one clip never needs them.

    Args:
        body: the agent's body.
        start: the observed frame at which it begins.
        info: up axis of its world.
        memory: its memory before that frame is written; ``None`` without one.
    """

    def __init__(self, body: Body, start: Observations, info: TrajectoryInfo, memory: Memory | None) -> None:
        self.body, self._waiting = body, [start]
        self._mapper = GroundMapper(info.world_up, body)
        self._floor = self._mapper.floor_under(start.cameras.centers[0])
        self._cells: CellGrid | None = None  # of a scene, as they were when the map came to know them
        if isinstance(memory, Scene):
            self.know(memory)
        elif memory is not None:
            self._mapper.add_memory(memory, self._floor)

    def know(self, scene: Scene) -> None:
        """Know the cells of a scene as they are now."""
        if scene.cells is not self._cells:
            self._cells = scene.cells
            self._mapper.add_memory(scene, self._floor)

    def changed(self, scene: Scene, before: CellGrid) -> None:
        """Forget what frames showed where cells of a scene are others than before, and know its cells.

        Args:
            scene: after the change.
            before: its cells before it.
        """
        self.map()  # what waits was seen before the change
        after = scene.cells
        then = before.box(after.corner, after.shape)
        differ = (after.classes.cpu() != then.classes) | (after.known.cpu() != then.known)
        self._mapper.forget(after.columns().cpu()[differ.any(-1)], after.form.size)
        self.know(scene)

    def see(self, frames: Observations) -> None:
        """Add frames, observed or imagined."""
        self._waiting.append(frames)

    def map(self) -> GroundMap:
        """Return the map with all that was seen."""
        for frames in self._waiting:
            self._mapper.add(frames)
        self._waiting.clear()
        return self._mapper.map()

    def copy(self) -> Surroundings:
        """Return surroundings that know the same; what is added to one of the two does not change the other."""
        self.map()  # what waits is added once for all copies
        copy = Surroundings.__new__(Surroundings)
        copy.body, copy._waiting, copy._mapper = self.body, [], self._mapper.copy()
        copy._floor, copy._cells = self._floor, self._cells
        return copy

    def first_blocked(self, seen: Observations) -> int | None:
        """Return the first of some imagined frames that cannot be reached, by what the frames before it show.

        The frames before that one, or all of them, are seen from now on.
        """
        poses = seen.cameras.world_from_camera
        for number in range(1, len(seen)):
            self.see(seen[number - 1 : number])
            if self.blocks(poses[number - 1], poses[number]):
                return number
        self.see(seen[-1:])
        return None

    def blocks(self, start: Pose, end: Pose) -> bool:
        """Return whether something known is in the way between two poses; what is unknown counts as free."""
        return blocked([self], [start], [end])[0]


def blocked(surroundings: Sequence[KnownSurroundings], starts: Sequence[Pose], ends: Sequence[Pose]) -> list[bool]:
    """Return for each agent whether something is in its way between two poses; what is unknown counts as free."""
    verdicts = [False] * len(starts)
    maps = [one.map() for one in surroundings]
    for ground in {id(one): one for one in maps}.values():
        rows = [number for number, one in enumerate(maps) if one is ground]
        first, last = (ground.places(torch.stack([poses[row][:3, 3] for row in rows])) for poses in (starts, ends))
        covers = way_is_free(ground, first, last, surroundings[rows[0]].body.radius)
        for row, cover in zip(rows, covers.tolist(), strict=True):
            verdicts[row] = cover == Cover.OCCUPIED
    return verdicts


@dataclass
class Walk:
    """The actions of one agent for the next clip, of which the blocked ones do not move it.

    Args:
        info: up axis and vocabulary.
        camera: the present camera, with a frame axis of one.
        surroundings: what it knows of the ground; ``None`` for an agent without a body, which nothing blocks.
    """

    info: TrajectoryInfo
    camera: Cameras
    surroundings: KnownSurroundings | None

    def __post_init__(self) -> None:
        self.names: list[str] = []
        self.free: list[bool] = []
        self.poses: list[Pose] = []  # after each free action
        self.world_up = torch.tensor(self.info.world_up, dtype=torch.float64)

    @property
    def pose(self) -> Pose:
        """The pose after the actions so far."""
        return self.poses[-1] if self.poses else self.camera.world_from_camera[0]

    @property
    def cameras(self) -> Cameras:
        """The cameras after the actions that are free."""
        return self.camera.at(torch.stack(self.poses))

    @property
    def path(self) -> Float[Tensor, "action 4 4"]:
        """The pose after each action, float64; a blocked one leaves it as it was."""
        start = self.camera.world_from_camera[0].double()
        return torch.stack([start, *self.poses])[self.verdicts.cumsum(0)]

    @property
    def moves(self) -> list[str]:
        """The actions that are free."""
        return [name for name, free in zip(self.names, self.free, strict=True) if free]

    def after(self, name: str) -> Pose:
        """Return the pose after one more action."""
        return self.info.vocabulary.move(self.pose, name, self.world_up)

    def take(self, name: str, pose: Pose, free: bool) -> None:
        """Append an action, which leads to a pose if it is free."""
        self.names.append(name)
        self.free.append(free)
        if free:
            self.poses.append(pose)

    def cut(self, moves: int) -> None:
        """Keep so many of the free actions, with the blocked ones before the next."""
        count = [number for number, free in enumerate(self.free) if free][moves]
        self.names, self.free, self.poses = self.names[:count], self.free[:count], self.poses[:moves]

    def frames(self, now: Observations, seen: Observations) -> Observations:
        """Return a frame for each action: of those that were imagined, or after a blocked one the frame before it."""
        both = Observations.concatenate([now, seen]) if len(seen) else now
        return both[self.verdicts.cumsum(0)]

    @property
    def verdicts(self) -> Bool[Tensor, " action"]:
        """Whether each action was free."""
        return torch.tensor(self.free, dtype=torch.bool)


def plan_walks(walks: Sequence[Walk], actions: Sequence[Sequence[str]], most: int) -> None:
    """Let each walk take of its actions as many as one clip holds; those of one map are judged together.

    Args:
        walks: new walks.
        actions: names in the vocabulary, for each walk those that are left to take.
        most: number of moves that a clip holds.
    """
    for step in range(max(map(len, actions))):
        going = [n for n, walk in enumerate(walks) if step < len(actions[n]) and len(walk.poses) < most]
        names = [actions[n][step] for n in going]
        ends = [walks[n].after(name) for n, name in zip(going, names, strict=True)]
        free = _free([walks[n] for n in going], names, ends)
        for n, name, end, is_free in zip(going, names, ends, free, strict=True):
            walks[n].take(name, end, is_free)
        if not going:
            return


def whole_walks(
    camera: Cameras, info: TrajectoryInfo, actions: Sequence[Sequence[str]], surroundings: KnownSurroundings | None
) -> list[Walk]:
    """Return walks that begin at one camera and take all of their actions.

    Args:
        camera: with a frame axis of one.
        info: up axis and vocabulary.
        actions: names in the vocabulary, for each of one walk or more; a walk may have none.
        surroundings: what all of them know of the ground; ``None`` to go through walls.
    """
    walks = [Walk(info, camera, surroundings) for _ in actions]
    plan_walks(walks, actions, max(map(len, actions)))
    return walks


def _free(walks: Sequence[Walk], names: Sequence[str], ends: Sequence[Pose]) -> list[bool]:
    """Whether each walk can take its next action; turns are always free."""
    free = [True] * len(walks)
    pairs = enumerate(zip(walks, names, strict=True))
    stepping = [
        (row, walk.surroundings)
        for row, (walk, name) in pairs
        if walk.surroundings is not None and walk.info.vocabulary[name].forward
    ]
    if stepping:
        rows, surroundings = zip(*stepping, strict=True)
        stopped = blocked(surroundings, [walks[row].pose for row in rows], [ends[row] for row in rows])
        for row, stop in zip(rows, stopped, strict=True):
            free[row] = not stop
    return free
