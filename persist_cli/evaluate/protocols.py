"""Protocols: which clips are predicted, and what the memory holds when they begin."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from jaxtyping import Bool, Float
from torch import Tensor

from persist_cli.api.geometry import pose_differences
from persist_cli.api.observations import Observations
from persist_cli.data.store import Store, TrajectoryFile
from persist_cli.errors import DataError
from persist_cli.evaluate.cases import Case
from persist_cli.evaluate.coverage import GRID, held_frames, recalled_share, seen_share
from persist_cli.viewing.console import watched

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


LEAST_RECALLED = 0.3  # share of the last view seen earlier and not from the clip's first frame


class Revisit(Protocol):
    """The paper's Table 1: the memory holds every frame before the clip, as it really was."""

    name = "revisit"
    title = "Places seen before"
    definition = (
        f"at least {LEAST_RECALLED:.0%} of the clip's last view (a grid of {GRID}×{GRID} pixels) was seen by frames "
        "before the clip and not from its first frame; memory of all true frames up to the first; nothing is written"
    )
    writes = False
    selections = ("all", "last", "new")

    def find(self, asked: Selected) -> list[Case]:
        """The clips with the most to recall, taking turns over trajectories, disjoint within each."""
        frames = asked.frames or asked.clip + 1
        files = watched(trajectories(asked.folders), "what returns", "trajectory")
        ranked = [self.rank(file, frames) for file in files]
        turns = range(max(map(len, ranked), default=0))
        chosen = [(row[turn], number) for turn in turns for number, row in enumerate(ranked) if turn < len(row)]
        if not chosen:
            raise DataError(
                f"{names(asked.folders)}: no clip of {frames} frames returns to a place seen before; collect with "
                "--policy there-and-back or longer trajectories"
            )
        return self.cases(chosen[: asked.most], frames, asked)

    def cases(self, chosen: list[tuple[int, int]], frames: int, asked: Selected) -> list[Case]:
        """The cases of (start, number of the trajectory), each trajectory read once."""
        files = trajectories(asked.folders)
        found: dict[tuple[int, int], Case] = {}
        for number in watched(list(dict.fromkeys(number for _, number in chosen)), "seen before", "trajectory"):
            seen = files[number].read().observations
            for start in (start for start, owner in chosen if owner == number):
                found[start, number] = self.case(files[number], seen, (start, frames, start + 1), asked)
        return [found[each] for each in chosen]

    def rank(self, file: TrajectoryFile, frames: int) -> list[int]:
        """Starts of disjoint clips of one trajectory that recall enough, the most first."""
        if len(file) < frames + 2:
            return []
        seen = file.read().observations
        require_depth(seen, file, self.name)
        first = min(frames, len(file) - frames)  # short trajectories still have something before their clip
        starts = range(first, len(file) - frames + 1, max(1, (frames - 1) // 2))
        shares = {start: recalled_share(seen, start, start + frames - 1) for start in starts}
        enough = sorted((start for start in starts if shares[start] >= LEAST_RECALLED), key=lambda each: -shares[each])
        disjoint: list[int] = []
        for start in enough:
            if all(abs(start - other) >= frames for other in disjoint):
                disjoint.append(start)
        return disjoint


class Unseen(Revisit):
    """As ``revisit``, on data whose origin shows that it was not trained on."""

    name = "unseen"
    title = "Unseen houses and simulators"
    definition = (
        f"as revisit ({Revisit.definition}); no scene comes from the simulator's training split or from the model's "
        "training data, and each data set has a table of its own"
    )
    domains = True

    def find(self, asked: Selected) -> list[Case]:
        """The most clips of each data set."""
        for file in trajectories(asked.folders):
            source = file.info.source
            if source.get("split") == "train":
                raise DataError(f"{file.path}: its scene is of the training split; collect with --split test")
            if file.info.scene in asked.training_scenes:
                raise DataError(f"{file.path}: the model was trained on its scene {file.info.scene!r}")
        found: list[Case] = []
        for folder in asked.folders:
            found += super().find(dataclasses.replace(asked, folders=[folder]))
        return found


SAME_METRES, SAME_DEGREES = 0.02, 2.0  # within which two poses are the same

AWAY_METRES, AWAY_DEGREES = 0.5, 45.0  # of which a path must exceed one before it returns

FRAMES = 49  # of a clip, when half of the trajectories come back that far

FEWEST = 5


class ThereAndBack(Protocol):
    """The paper's SRC: go somewhere, return by the reversed actions."""

    name = "return"
    title = "There and back"
    definition = (
        f"there and back by the same poses (within {SAME_METRES} m and {SAME_DEGREES:g}°), after a path that leaves "
        f"its first pose by more than {AWAY_METRES} m or {AWAY_DEGREES:g}°; the memory begins empty and is written "
        "with the given frame and the model's own output"
    )
    writes = True
    selections = ("all", "return")
    guards = ("copy", "truth")  # a frozen video has the best SRC, the truth not quite

    def find(self, asked: Selected) -> list[Case]:
        """One clip of each trajectory that turns round and comes back far enough, all of one length."""
        poses = {file.path: file.poses() for file in trajectories(asked.folders)}
        files = watched(trajectories(asked.folders), "turning points", "trajectory")
        turns = {file.path: turning_point(poses[file.path]) for file in files}
        lengths = [length for _, length in turns.values() if length >= FEWEST]
        frames = asked.frames or min(FRAMES, sorted(lengths)[len(lengths) // 2] if lengths else FRAMES)
        cases: list[Case] = []
        for file in watched(trajectories(asked.folders), "seen before", "trajectory"):
            twice, length = turns[file.path]
            if length < max(frames, FEWEST) or len(cases) == asked.most:
                continue
            start = (twice - frames + 1) // 2
            if goes_away(poses[file.path][start : start + frames]):
                cases.append(self.returning(file, start, frames, twice, asked))
        if not cases:
            longest = max((length for _, length in turns.values()), default=0)
            raise DataError(
                f"{names(asked.folders)}: no trajectory goes away and comes back by the same poses within {frames} "
                f"frames (the longest there and back has {longest}); collect with --policy there-and-back"
            )
        return cases

    def returning(self, file: TrajectoryFile, start: int, frames: int, twice: int, asked: Selected) -> Case:
        """A case whose later frames return to its earlier ones."""
        seen = file.read(slice(0, start + frames)).observations
        case = self.case(file, seen, (start, frames, 0), asked)
        partners = [twice - (start + number) - start for number in range(frames)]
        visits = [earlier if 0 <= earlier < number - 1 else -1 for number, earlier in enumerate(partners)]
        return dataclasses.replace(case, first_visits=tuple(visits))


def turning_point(poses: Float[Tensor, "frame 4 4"]) -> tuple[int, int]:
    """Where a path mirrors itself the longest: twice the number of the turning frame, and frames of the mirrored part.

    Twice, because a path may turn between two frames.
    """
    best = (0, 0)
    for twice in range(1, 2 * len(poses) - 2):
        first, last = twice // 2, (twice + 1) // 2
        count = min(first + 1, len(poses) - last)
        same = same_poses(poses[first - count + 1 : first + 1].flip(0), poses[last : last + count])
        alike = count if bool(same.all()) else int((~same).nonzero()[0])
        length = 2 * alike - (1 if twice % 2 == 0 else 0)
        if length > best[1]:
            best = (twice, length)
    return best


def same_poses(first: Float[Tensor, "pose 4 4"], second: Float[Tensor, "pose 4 4"]) -> Bool[Tensor, " pose"]:
    """Which pairs of poses are the same."""
    metres, degrees = pose_differences(first, second)
    return (metres < SAME_METRES) & (degrees < SAME_DEGREES)


def goes_away(poses: Float[Tensor, "frame 4 4"]) -> bool:
    """Whether a path leaves its first pose far enough to ask for a memory."""
    metres, degrees = pose_differences(poses, poses[:1].expand_as(poses))
    return bool(((metres > AWAY_METRES) | (degrees > AWAY_DEGREES)).any())


LEAST = 112  # frames to predict, as in the paper


class Long(Protocol):
    """The paper's long video: many clips one after the other from a single given frame."""

    name = "long"
    title = "Long rollout"
    definition = (
        f"at least {LEAST} frames predicted clip after clip from one given frame along the true path; the memory "
        "begins empty and is written with the given frame and the model's own output"
    )
    writes = True
    selections = ("all", "last")

    def find(self, asked: Selected) -> list[Case]:
        """Clips from the beginning of each trajectory on, disjoint."""
        frames = asked.frames or LEAST + 1
        if frames <= LEAST:
            raise DataError(f"the protocol 'long' predicts at least {LEAST} frames; --frames {frames} are too few")
        files = trajectories(asked.folders)
        places = [(file, start) for file in files for start in range(0, len(file) - frames + 1, frames)]
        if not places:
            longest = max(len(file) for file in files)
            raise DataError(
                f"{names(asked.folders)}: no trajectory has {frames} frames, the longest has {longest}; "
                f"collect with --frames {frames}"
            )
        return [
            self.case(file, file.read(slice(0, start + frames)).observations, (start, frames, 0), asked)
            for file, start in watched(places[: asked.most], "seen before", "clip")
        ]


PROTOCOLS: dict[str, Protocol] = {protocol.name: protocol for protocol in (Revisit(), ThereAndBack(), Long(), Unseen())}

__all__ = ["PROTOCOLS", "Protocol", "Selection"]
