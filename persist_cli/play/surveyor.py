"""Draws the map of a walk."""

from __future__ import annotations

from collections import deque
from typing import Final

from persist_cli.api.ground import ground_axes
from persist_cli.api.policy import Goal
from persist_cli.play.ground_picture import (
    Backdrop,
    GroundPicture,
    Marks,
    backdrop_of_ground,
    backdrop_of_points,
    draw_ground,
)
from persist_cli.play.settings import GroundPose
from persist_cli.play.walkers import Walkers

MOST_PLACES: Final = 5000  # of the way that is drawn; older ones are forgotten


class Surveyor:
    """The way of the walkers, and the map of what the first of them remembers.

    Args:
        walkers: stand at the start.
    """

    def __init__(self, walkers: Walkers) -> None:
        self._walkers = walkers
        self._way: deque[tuple[float, float, bool]] = deque(maxlen=MOST_PLACES)  # and whether it was jumped to
        self._backdrop: Backdrop | None = None
        self._version = -1  # of what is remembered, as the backdrop shows it
        self.home = self.pose

    @property
    def pose(self) -> GroundPose:
        """Where the agent stands."""
        return GroundPose.of(self._walkers.pose, self._walkers.info.world_up)

    def begin(self) -> None:
        """Forget the way, and begin a new one here."""
        self._way.clear()
        self.went(jumped=True)

    def went(self, jumped: bool) -> None:
        """Take in that the agent has gone, or has jumped, to where it stands now."""
        pose = self.pose
        self._way.append((pose.x, pose.y, jumped))

    def undo(self) -> None:
        """Forget the last place of the way."""
        if len(self._way) > 1:
            self._way.pop()

    def draw(self, size: int, goal: Goal | None) -> GroundPicture:
        """Return the map; with millions of remembered points it takes seconds.

        Args:
            size: pixels of its longer side.
            goal: is marked where it has a place.
        """
        if self._walkers.version != self._version:
            self._backdrop, self._version = self._survey(), self._walkers.version
        return draw_ground(self._backdrop, Marks(self.pose, self.home, self._parts(), self._place(goal)), size)

    def _place(self, goal: Goal | None) -> tuple[float, float] | None:
        """Return where a goal lies on the ground axes."""
        if goal is None or goal.position is None:
            return None
        x, y = (ground_axes(self._walkers.info.world_up)[:2] @ goal.position).tolist()
        return x, y

    def _survey(self) -> Backdrop | None:
        """Return what the first memory holds, or where it has no points what is known of the ground."""
        lead, info = self._walkers.lead, self._walkers.info
        if lead.memory is not None:
            points = lead.memory.points()
            if len(points.positions):
                axes = ground_axes(info.world_up)
                return backdrop_of_points(points, axes, float(axes[2] @ self._walkers.pose[:3, 3].cpu().double()))
        return None if lead.surroundings is None else backdrop_of_ground(lead.surroundings.map())

    def _parts(self) -> list[list[tuple[float, float]]]:
        """Return the way in parts, of which each begins with a jump."""
        parts: list[list[tuple[float, float]]] = [[]]
        for x, y, jumped in self._way:
            if jumped:
                parts.append([])
            parts[-1].append((x, y))
        return [part for part in parts if part]
