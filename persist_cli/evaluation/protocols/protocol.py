"""The abstract protocol."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from persist_cli.evaluation.cases import Case
from persist_cli.evaluation.seen import held_frames, seen_share
from persist_cli.trajectories.store import Store, TrajectoryFile
from persist_cli.world.errors import DataError
from persist_cli.world.observations import Observations

Selection = Literal["all", "last", "return", "new"]  # frames of a clip that a column is the mean over


@dataclass(frozen=True)
class Selected:
    """Which clips are asked for.

    Args:
        folders: of the data sets.
        frames: of a clip, the given one included; 0 takes the protocol's own number.
        most: most clips.
        clip: frames that the backbone predicts at once.
        training_scenes: names of scenes that a model is known to have been trained on.
    """

    folders: Sequence[Path]
    frames: int
    most: int
    clip: int
    training_scenes: frozenset[str] = frozenset()


class Protocol(ABC):
    """A way to choose clips and to fill the memory.

    Every clip begins with a given frame. ``writes`` says whether the model's own output goes into the memory;
    ``selections`` says over which frames the first metrics are shown.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    definition: ClassVar[str]
    writes: ClassVar[bool]
    selections: ClassVar[tuple[Selection, ...]]
    domains: ClassVar[bool] = False  # whether each data set gets a table of its own
    guards: ClassVar[tuple[str, ...]] = ()  # controls without which its figures could be misread

    @abstractmethod
    def find(self, asked: Selected) -> list[Case]:
        """The clips.

        Raises:
            DataError: one line, when there is none.
        """

    def case(self, file: TrajectoryFile, seen: Observations, where: tuple[int, int, int], asked: Selected) -> Case:
        """A case without returns.

        Args:
            file: the trajectory.
            seen: its frames, at least up to the clip's last.
            where: number of the first frame, frames of the clip, frames of context.
            asked: for the frames predicted at once.
        """
        start, frames, context = where
        shares = [
            seen_share(seen, start + frame, held_frames(start, context, frame, asked.clip, self.writes))
            for frame in range(frames)
        ]
        return Case(
            data=str(file.path.parent),
            trajectory=file.name,
            scene=file.info.scene,
            start=start,
            frames=frames,
            context=context,
            seen_before=tuple(shares),
            first_visits=(-1,) * frames,
        )


def trajectories(folders: Sequence[Path]) -> list[TrajectoryFile]:
    """Every trajectory of the data sets, in order."""
    return [file for folder in folders for file in Store(folder)]


def names(folders: Sequence[Path]) -> str:
    """The data sets for an error message."""
    return ", ".join(map(str, folders))


def require_depth(seen: Observations, file: TrajectoryFile, protocol: str) -> None:
    """Raise ``DataError`` when no frame has depth."""
    if not bool((seen.depth > 0).any()):
        raise DataError(
            f"{file.path}: no frame has depth, which the protocol {protocol!r} needs to know what was seen before; "
            "evaluate it with --protocol return or long"
        )
