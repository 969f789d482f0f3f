"""Maps of the ground, which grow with each posed depth frame and with the points of a memory.

For example an agent looks at a wall 2 m ahead. The squares that the wall's pixels lie in become occupied. The squares
between the camera and the wall become free, even where they are too near to be in the image: rays that reach a farther
thing passed over them. What is low and stands right before the agent's feet can hide there, until it was seen from
farther away.

What was observed counts before what a memory holds, and that before what was imagined. An observed frame is exact, so
one pixel of it makes a square occupied. Imagined frames disagree with each other, so there the majority decides. The
imagined cells of a scene count before imagined frames, which are renderings of them. Its observed solid cells count
before what rays passed over: the scene was written with these frames too, and knows what is below the image.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import IntEnum

import torch
from jaxtyping import Bool, Float, Int32, Int64, UInt8
from torch import Tensor
from torch.nn import functional

from persist_cli.api.cameras import Cameras
from persist_cli.api.geometry import unproject
from persist_cli.api.ground import Body, Cover, GroundMap, ground_axes
from persist_cli.api.memory import MapPoints, Memory
from persist_cli.api.observations import Observations, Origin, TrajectoryInfo
from persist_cli.api.scene import Scene
from persist_cli.errors import DataError

SPACING = 0.05  # metres of a square's side
REACH = 6.0  # metres on the ground beyond which a frame's pixels are too coarse to tell
MARGIN = 40  # squares that a map grows by beyond what it must, so that it seldom grows
CELL_SHARE = 0.8  # of the edge of a scene's cell that is in the way: walls of 0.2 m in cells of 0.25 m
LEAST_AHEAD = 0.1  # of a unit view direction that must point along the ground, else nothing is ahead


class Vote(IntEnum):
    """What the numbers that a map keeps for each square count."""

    STOOD = 0  # observed frames whose camera was over it
    OBSERVED_OCCUPIED = 1  # observed frames
    OBSERVED_FREE = 2
    REMEMBERED_OCCUPIED = 3  # points of a memory
    REMEMBERED_FREE = 4
    IMAGINED_OCCUPIED = 5  # imagined frames, and imagined points of a memory
    IMAGINED_FREE = 6
    SCENE_OCCUPIED = 7  # observed cells of a scene
    SCENE_IMAGINED_OCCUPIED = 8  # imagined cells of a scene, of which imagined frames are renderings
    SCENE_IMAGINED_FREE = 9


def tells_body(info: TrajectoryInfo) -> bool:
    """Return whether it is known how high the agent's camera is: in a simulator's data, or where the source tells it.

    In other data, such as captures by hand, the floor may lie anywhere below the camera, and with a wrong height the
    floor itself would be in the way.
    """
    return "simulator" in info.source or "camera_height" in info.source


def knows_floor(info: TrajectoryInfo, body: Body | None) -> bool:
    """Return whether a map of the ground can be made: the data tell the camera's height, or the agent has a body.

    Else nothing is known of the ground, since the floor itself could seem to be in the way.
    """
    return body is not None or tells_body(info)


def body_of(info: TrajectoryInfo) -> Body:
    """Return the body of a trajectory's agent, with the camera height and radius that its source tells.

    ``persist collect`` tells a height that is not the default as ``camera_height`` of ``camera``. Where nothing is
    told, as for captures, the defaults of ``Body`` stand. A body is never lower than its camera.

    Raises:
        DataError: when what is told is no positive number.
    """
    camera = info.source.get("camera")
    source = {**camera, **info.source} if isinstance(camera, Mapping) else info.source
    told = {name: source[name] for name in ("camera_height", "radius") if name in source}
    for name, value in told.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < math.inf:
            raise DataError(f"{info.scene}: its source tells a {name} of {value!r}; it must be metres above 0")
    body = replace(Body(), **told)
    return replace(body, height=max(body.height, body.camera_height))


class GroundMapper:
    """A map of the ground that grows with frames and points.

    The middle of a square lies under the first camera (or at the first point), so a moved world changes nothing.

    Args:
        world_up: unit vector that points up in the world.
        body: what is in its way is occupied. The floor lies ``camera_height`` below each camera.
        spacing: metres of a square's side.
    """

    def __init__(self, world_up: Sequence[float], body: Body, spacing: float = SPACING) -> None:
        self.body, self.spacing, self.axes = body, spacing, ground_axes(world_up)
        self._anchor: Float[Tensor, " 2"] | None = None  # the place of the corner of square (0, 0)
        self._low = torch.zeros(2, dtype=torch.int64)  # row and column of the first square of ``_votes``
        self._votes = torch.zeros(len(Vote), 0, 0, dtype=torch.int32)
        self._states = torch.zeros(0, 0, dtype=torch.uint8)  # by the votes, but for those counted since; replaced whole
        self._counted: list[Int64[Tensor, "2 2"]] = []  # lowest and highest squares of these
        self._map: GroundMap | None = None

    def copy(self) -> GroundMapper:
        """Return a mapper that knows the same; adding to one of the two does not change the other."""
        copy = GroundMapper.__new__(GroundMapper)
        own = {"_votes": self._votes.clone(), "_low": self._low.clone(), "_counted": list(self._counted)}
        copy.__dict__ |= self.__dict__ | own
        return copy

    def add(self, observations: Observations) -> None:
        """Add posed frames, observed or imagined as their origins say; pixels without depth say nothing."""
        frames = observations.to("cpu")
        for number in range(len(frames)):
            self._add_frame(frames.depth[number], frames.cameras[number], int(frames.origins[number]))

    def add_points(self, points: MapPoints, floor: float) -> None:
        """Add the points of a memory.

        Points between ``step_over`` and the body's height make squares occupied, those on the floor make squares free.
        A point stands for ``spread`` metres on the ground and for ``rise`` metres of height: where its lower end is
        under the floor's noise it may be floor or a low thing, and counts as floor. One that stands for more height
        than a body, as in a flat map, says nothing.

        Args:
            points: of ``Memory.points``.
            floor: height of the floor along up, metres.
        """
        positions = points.positions.cpu().double() @ self.axes.T
        bottom = positions[:, 2] - floor - points.rise / 2
        near = (bottom <= self.body.height) & (bottom + points.rise >= -self.body.step_over)
        if points.rise > self.body.height or not bool(near.any()):
            return
        places, bottom, origins = positions[near, :2], bottom[near], points.origins.cpu()[near]
        blocking, observed = bottom > self.body.step_over, origins >= Origin.OBSERVED
        for chosen, vote in (
            (blocking & observed, Vote.REMEMBERED_OCCUPIED),
            (~blocking & observed, Vote.REMEMBERED_FREE),
            (blocking & ~observed, Vote.IMAGINED_OCCUPIED),
            (~blocking & ~observed, Vote.IMAGINED_FREE),
        ):
            # half as large where occupied: a wall lies anywhere in its cell, and a body does not fit between two cells
            side = points.spread / 2 if vote in (Vote.REMEMBERED_OCCUPIED, Vote.IMAGINED_OCCUPIED) else points.spread
            self._count(vote, self._squares(places[chosen], side))

    def add_memory(self, memory: Memory, floor: float) -> None:
        """Add what a memory holds; the cells of a scene take the place of those it had before.

        Args:
            memory: the memory.
            floor: height of the floor along up, metres.
        """
        if isinstance(memory, Scene):
            self.set_scene(memory.points(), floor)
        else:
            self.add_points(memory.points(), floor)

    def set_scene(self, points: MapPoints, floor: float) -> None:
        """Know the solid cells of a scene as they are now, in place of all points before.

        The floor lies in the middle of its cells, and what is higher is in the way: where a wall stands, nearly all of
        its cell. An imagined thing on observed floor is in the way too, as one that was put down there.

        Args:
            points: of ``Scene.points``.
            floor: height of the floor along up, metres.
        """
        votes = (Vote.SCENE_OCCUPIED, Vote.REMEMBERED_FREE, Vote.SCENE_IMAGINED_OCCUPIED, Vote.SCENE_IMAGINED_FREE)
        for vote in (*votes, Vote.REMEMBERED_OCCUPIED):
            self._votes[vote] = 0
        self._all_counted()
        positions = points.positions.cpu().double() @ self.axes.T
        height, origins = positions[:, 2] - floor, points.origins.cpu()
        near = (height - points.rise / 2 <= self.body.height) & (height + points.rise / 2 >= -self.body.step_over)
        blocking, observed = height > self.body.step_over, origins >= Origin.OBSERVED
        kinds = (blocking & observed, ~blocking & observed, blocking & ~observed, ~blocking & ~observed)
        for chosen, vote in zip(kinds, votes, strict=True):
            free = vote in (Vote.REMEMBERED_FREE, Vote.SCENE_IMAGINED_FREE)
            side = points.spread if free else CELL_SHARE * points.spread
            squares = self._squares(positions[near & chosen, :2], side)
            if vote == Vote.REMEMBERED_FREE:
                standing = positions[near & blocking & ~observed, :2]
                squares = without(squares, self._squares(standing, CELL_SHARE * points.spread))
            self._count(vote, squares)

    def forget(self, places: Float[Tensor, "place 2"], side: float) -> None:
        """Forget what frames showed around places on the ground axes, in squares of a side in metres: it changed."""
        size = torch.tensor(self._votes.shape[1:])
        squares = self._squares(places, side) - self._low
        rows, columns = squares[((squares >= 0) & (squares < size)).all(1)].unbind(1)
        for vote in (Vote.OBSERVED_OCCUPIED, Vote.OBSERVED_FREE, Vote.IMAGINED_OCCUPIED, Vote.IMAGINED_FREE):
            self._votes[vote][rows, columns] = 0
        self._all_counted()

    def add_collision(self, camera: Cameras, forward: float) -> None:
        """Add that a true agent was stopped: what is right before its body, to half its width, is occupied.

        Low things hide below the image, where only a collision tells of them.

        Args:
            camera: the agent's camera, single, where it was stopped.
            forward: metres that the step would have gone along the heading; negative values go backward.
        """
        place = (self.axes @ camera.centers.double())[:2]
        heading = (self.axes @ camera.world_from_camera[:3, 2].double())[:2]
        ahead = heading / heading.norm().clamp_min(1e-9) * math.copysign(1.0, forward)
        aside = torch.stack([-ahead[1], ahead[0]])
        half = round(self.body.radius / 2 / self.spacing)
        across = torch.arange(-half, half + 1, dtype=torch.float64)[:, None] * self.spacing
        front = place + (self.body.radius + self.spacing) * ahead
        self._count(Vote.OBSERVED_OCCUPIED, self._squares(front + across * aside))

    def floor_under(self, camera: Float[Tensor, " 3"]) -> float:
        """Return the height of the floor along up under a camera's position in world metres."""
        return float(self.axes[2] @ camera.cpu().double()) - self.body.camera_height

    def map(self) -> GroundMap:
        """Return what is known now."""
        if self._map is None:
            self._map = self._decide()
        return self._map

    def _decide(self) -> GroundMap:
        self._states = self._decided()
        self._counted = []
        if self._anchor is None:
            return GroundMap(self._states, (0.0, 0.0), self.spacing, self.axes)
        x, y = (self._anchor + self._low.flip(0) * self.spacing).tolist()
        return GroundMap(self._states, (x, y), self.spacing, self.axes)

    def _decided(self) -> UInt8[Tensor, "row column"]:
        """Return what the votes say of all squares, looked at anew only around those that were counted since."""
        if not self._counted:
            return self._states
        box = torch.stack(self._counted)
        (top, left), (bottom, right) = (
            (box[:, 0].amin(0) - self._low).tolist(),
            (box[:, 1].amax(0) - self._low).tolist(),
        )
        window = (slice(top, bottom + 1), slice(left, right + 1))
        states = self._states.clone()
        states[window] = self._covers(self._votes[:, window[0], window[1]])
        return states

    @staticmethod
    def _covers(votes: Int32[Tensor, "vote row column"]) -> UInt8[Tensor, "row column"]:
        """Return what votes say of squares."""
        imagined = votes[Vote.IMAGINED_OCCUPIED], votes[Vote.IMAGINED_FREE]
        states = torch.full(votes.shape[1:], int(Cover.UNKNOWN), dtype=torch.uint8)
        for occupied, free in (
            (imagined[0] > imagined[1], (imagined[1] > 0) & (imagined[0] <= imagined[1])),
            (votes[Vote.SCENE_IMAGINED_OCCUPIED] > 0, votes[Vote.SCENE_IMAGINED_FREE] > 0),
            (votes[Vote.REMEMBERED_OCCUPIED] > 0, votes[Vote.REMEMBERED_FREE] > 0),
            (votes[Vote.OBSERVED_OCCUPIED] > 0, votes[Vote.OBSERVED_FREE] > 0),
        ):
            states[free] = int(Cover.FREE)
            states[occupied] = int(Cover.OCCUPIED)
        states[votes[Vote.SCENE_OCCUPIED] > 0] = int(Cover.OCCUPIED)
        states[votes[Vote.STOOD] > 0] = int(Cover.FREE)
        return states

    def _all_counted(self) -> None:
        """Let all squares be looked at anew."""
        self._map = None
        size = torch.tensor(self._votes.shape[1:])
        self._counted = [torch.stack([self._low, self._low + size - 1])] if bool(size.prod()) else []

    def _add_frame(self, depth: Float[Tensor, "height width"], camera: Cameras, origin: int) -> None:
        """Add one frame."""
        observed = origin == Origin.OBSERVED
        center = self.axes @ camera.centers.double()
        stood = self._disc(center[:2])
        points = unproject(depth, camera)[depth > 0] @ self.axes.T - center
        height = points[:, 2] + self.body.camera_height
        near = (points[:, :2].norm(dim=1) < REACH) & (height >= -self.body.step_over) & (height <= self.body.height)
        places, blocking = points[near, :2], height[near] > self.body.step_over
        occupied = self._squares(center[:2] + places[blocking])
        free = [self._squares(center[:2] + places[~blocking]), self._under_rays(camera, center[:2], places, blocking)]
        if not observed:
            free.append(stood)
        self._count(Vote.OBSERVED_OCCUPIED if observed else Vote.IMAGINED_OCCUPIED, occupied)
        self._count(Vote.OBSERVED_FREE if observed else Vote.IMAGINED_FREE, without(torch.cat(free), occupied))
        if observed:
            self._count(Vote.STOOD, stood)

    def _under_rays(
        self,
        camera: Cameras,
        center: Float[Tensor, " 2"],
        places: Float[Tensor, "point 2"],
        blocking: Bool[Tensor, " point"],
    ) -> Int64[Tensor, "square 2"]:
        """Return the squares that rays passed over at the height of the body, before the first thing in its way.

        They are found in a level camera with the heading of this one: each of its columns is free up to the nearest
        blocking point in it, or else to the farthest point of the floor.

        Args:
            camera: a single camera.
            center: its place.
            places: of points at the body's height and on the floor, relative to the centre.
            blocking: which of the points are in the way.
        """
        forward = (self.axes @ camera.world_from_camera[:3, 2].double())[:2]
        level = float(forward.norm())
        if level < LEAST_AHEAD or not len(places):
            return torch.zeros(0, 2, dtype=torch.int64)
        heading = torch.stack([forward, torch.stack([forward[1], -forward[0]])]) / level  # ahead, and to the right
        focal, middle = float(camera.intrinsics[0, 0]) * level, float(camera.intrinsics[0, 2])

        def seen(offsets: Float[Tensor, "point 2"]) -> tuple[Float[Tensor, " point"], Int64[Tensor, " point"]]:
            """Metres ahead and column of places; column 0 where they are not in view, others count from 1."""
            ahead, side = (offsets @ heading.T).unbind(1)
            column = (side / ahead.clamp_min(1e-6) * focal + middle).floor()
            return ahead, torch.where((ahead > 0) & (column >= 0) & (column < camera.width), column + 1, 0).long()

        ahead, column = seen(places)
        far = ahead.new_zeros(camera.width + 1).scatter_reduce(0, column, ahead, "amax")
        near = ahead.new_full((camera.width + 1,), math.inf).scatter_reduce(
            0, column[blocking], ahead[blocking], "amin"
        )
        clear = torch.minimum(near - self.spacing / 2, far)
        clear[0] = -math.inf
        squares = self._box(center, places)
        ahead, column = seen(self._middles(squares) - center)
        return squares[(ahead > 0) & (ahead < clear[column])]

    def _box(self, center: Float[Tensor, " 2"], places: Float[Tensor, "point 2"]) -> Int64[Tensor, "square 2"]:
        """Return the squares of the smallest box around a camera and what it saw."""
        corners = torch.stack([places.amin(0).clamp_max(0.0), places.amax(0).clamp_min(0.0)])
        low, high = self._squares(center + corners)
        return torch.cartesian_prod(*(torch.arange(int(a), int(b) + 1) for a, b in zip(low, high, strict=True)))

    def _disc(self, place: Float[Tensor, " 2"]) -> Int64[Tensor, "square 2"]:
        """Return the squares whose middles lie under a body."""
        squares = self._squares(place[None], 2 * self.body.radius)
        return squares[(self._middles(squares) - place).norm(dim=1) < self.body.radius]

    def _squares(self, places: Float[Tensor, "place 2"], side: float = 0.0) -> Int64[Tensor, "square 2"]:
        """Return row and column of the squares at places, or of all in the larger squares of a side around them."""
        if self._anchor is None and len(places):
            self._anchor = places[0] - self.spacing / 2
        if self._anchor is None or not len(places):
            return torch.zeros(0, 2, dtype=torch.int64)
        squares = ((places - self._anchor) / self.spacing).floor().long().flip(1)
        around = round(side / 2 / self.spacing)
        if not around:
            return squares
        steps = torch.arange(-around, around + 1)
        return (squares[:, None] + torch.cartesian_prod(steps, steps)).reshape(-1, 2)

    def _middles(self, squares: Int64[Tensor, "square 2"]) -> Float[Tensor, "square 2"]:
        """Return the places of the middles of squares."""
        if self._anchor is None:
            return squares.double()
        return self._anchor + (squares.flip(1) + 0.5) * self.spacing

    def _count(self, vote: Vote, squares: Int64[Tensor, "square 2"]) -> None:
        """Count one vote for each of the squares; one that is named twice is counted once."""
        if not len(squares):
            return
        self._map = None
        low, high = squares.amin(0), squares.amax(0)
        self._grow(low, high)
        self._counted.append(torch.stack([low, high]))
        rows, columns = (squares - self._low).unbind(1)
        layer = self._votes[vote]
        layer[rows, columns] = layer[rows, columns] + 1  # of repeated indices one is kept: each counts once

    def _grow(self, low: Int64[Tensor, " 2"], high: Int64[Tensor, " 2"]) -> None:
        """Make room for the squares from ``low`` to ``high``."""
        size = torch.tensor(self._votes.shape[1:])
        if not size.prod():
            self._low, size = low.clone(), size * 0
        before, after = self._low - low, high + 1 - self._low - size
        if not bool((before > 0).any() | (after > 0).any()):
            return
        before, after = (torch.where(missing > 0, missing + MARGIN, 0) for missing in (before, after))
        top, left, bottom, right = *before.tolist(), *after.tolist()
        self._votes = functional.pad(self._votes, (left, right, top, bottom))
        self._states = functional.pad(self._states, (left, right, top, bottom), value=int(Cover.UNKNOWN))
        self._low = self._low - before


def without(squares: Int64[Tensor, "square 2"], others: Int64[Tensor, "other 2"]) -> Int64[Tensor, "square 2"]:
    """Return the squares that are not among the others."""
    if not len(others) or not len(squares):
        return squares
    width = 1 << 32
    keys, taken = (part[:, 0] * width + part[:, 1] for part in (squares, others))
    return squares[~torch.isin(keys, taken)]
