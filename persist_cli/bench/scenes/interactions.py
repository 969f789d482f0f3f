"""Interactions of the agents of a data set with houses whose cells are known."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np

from persist_cli.data.reference import parse_reference
from persist_cli.data.scene_truth import DROP, PICK_UP, interactions_of
from persist_cli.data.store import TrajectoryFile
from persist_cli.errors import DataError


@dataclass(frozen=True)
class Event:
    """An interaction that truly happened.

    Args:
        file: its trajectory.
        frame: the frame before it.
        action: its name.
        taken: the frame before what is put down was picked up; ``None`` where nothing is put down.
    """

    file: TrajectoryFile
    frame: int
    action: str
    taken: int | None = None

    @property
    def name(self) -> str:
        """Trajectory and frame."""
        return f"{self.file.name}:{self.frame}"


def find_events(data: str, scenes: Collection[str], most: int, seed: int) -> list[Event]:
    """Return interactions of a data set in random order; a larger number only adds some at the end.

    Args:
        data: reference of the data set.
        scenes: names of the houses that are measured.
        most: as many at most.
        seed: of the order.

    Raises:
        DataError: when the agents of these houses interact with nothing.
    """
    files = [file for file in parse_reference(data).trajectories() if file.info.scene in scenes and file.has_cells]
    events = [event for file in files for event in events_of(file)]
    if not events:
        raise DataError(
            f"{data}: its agents interact with nothing; `persist collect miniworld --policy interact` makes such data"
        )
    order = np.random.default_rng(seed).permutation(len(events))
    return [events[place] for place in order[:most]]


def events_of(file: TrajectoryFile) -> Iterator[Event]:
    """Yield the interactions of a trajectory, without a drop of what the agent brought along."""
    taken: int | None = None
    for frame, action in interactions_of(file):
        if action != DROP or taken is not None:
            yield Event(file, frame, action, taken if action == DROP else None)
        if action in (PICK_UP, DROP):
            taken = frame if action == PICK_UP else None
