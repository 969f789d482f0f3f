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
from persist_cli.data.held_out import HELD_OUT_FROM, was_trained_on
from persist_cli.data.store import Store, TrajectoryFile
from persist_cli.errors import DataError
from persist_cli.evaluate.cases import Case
from persist_cli.evaluate.coverage import GRID, held_frames, recalled_share, seen_share
from persist_cli.viewing.console import watched

FrameSelection = Literal["all", "last", "return", "new"]  # frames of a clip that a column is the mean over

LEAST_RECALLED = 0.3  # share of the last view seen earlier and not from the clip's first frame

SAME_METRES, SAME_DEGREES = 0.02, 2.0  # two poses that differ by less are the same pose

AWAY_METRES, AWAY_DEGREES = 0.5, 45.0  # a path must exceed one of them before it returns

RETURN_FRAMES = 49  # of a clip that returns, when half of the trajectories come back that far

LEAST_RETURN_FRAMES = 5

LEAST_LONG_FRAMES = 112  # frames to predict, as in the paper


@dataclass(frozen=True)
class ClipSearch:
    """Where a protocol looks for clips, and how long and how many they are.

    Args:
        folders: the data sets.
        frames: length of a clip, the given frame included; 0 takes the protocol's own number.
        limit: greatest number of clips.
        predicted_at_once: frames that the backbone predicts at once.
        training_scenes: names of scenes that a model is known to have been trained on.
    """

    folders: Sequence[Path]
    frames: int
    limit: int
    predicted_at_once: int
    training_scenes: frozenset[str] = frozenset()

    @property
    def where(self) -> str:
        """The data sets for an error message."""
        return ", ".join(map(str, self.folders))

    def trajectories(self) -> list[TrajectoryFile]:
        """Every trajectory of the data sets, in order."""
        return [file for folder in self.folders for file in Store(folder)]


class Protocol(ABC):
    """A way to choose clips and to fill the memory.

    Every clip begins with a given frame. ``writes`` says whether the model's own output goes into the memory;
    ``selections`` says over which frames the first metrics are shown.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    definition: ClassVar[str]
    writes: ClassVar[bool]
    selections: ClassVar[tuple[FrameSelection, ...]]
    domains: ClassVar[bool] = False  # whether each data set gets a table of its own
    guards: ClassVar[tuple[str, ...]] = ()  # controls without which its figures could be misread

    @abstractmethod
    def find(self, search: ClipSearch) -> list[Case]:
        """Find the clips.

        Raises:
            DataError: one line, when there is none.
        """

    def make_case(
        self, file: TrajectoryFile, seen: Observations, where: tuple[int, int, int], search: ClipSearch
    ) -> Case:
        """Make a case that returns to no earlier pose.

        Args:
            file: the trajectory.
            seen: the frames of the trajectory, at least up to the clip's last.
            where: number of the clip's first frame, frames of the clip, frames of context.
            search: says how many frames are predicted at once.
        """
        start, frames, context = where
        shares = [
            seen_share(seen, start + frame, held_frames(start, context, frame, search.predicted_at_once, self.writes))
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


class Revisit(Protocol):
    """The protocol of the paper's Table 1: the memory holds every true frame before the clip."""

    name = "revisit"
    title = "Places seen before"
    definition = (
        f"at least {LEAST_RECALLED:.0%} of the clip's last view (a grid of {GRID}×{GRID} pixels) was seen by frames "
        "before the clip and not from its first frame; memory of all true frames up to the first; nothing is written"
    )
    writes = False
    selections = ("all", "last", "new")

    def find(self, search: ClipSearch) -> list[Case]:
        """Find the clips with the most to recall, taking turns over trajectories, disjoint within each."""
        frames = search.frames or search.predicted_at_once + 1
        files = watched(search.trajectories(), "what returns", "trajectories")
        ranked = [self.rank_starts(file, frames) for file in files]
        turns = range(max(map(len, ranked), default=0))
        chosen = [
            (starts[turn], number) for turn in turns for number, starts in enumerate(ranked) if turn < len(starts)
        ]
        if not chosen:
            raise DataError(
                f"{search.where}: no clip of {frames} frames returns to a place seen before; collect with "
                "--policy there-and-back or longer trajectories, or evaluate with --protocol long"
            )
        return self.make_cases(chosen[: search.limit], frames, search)

    def rank_starts(self, file: TrajectoryFile, frames: int) -> list[int]:
        """Starts of disjoint clips of one trajectory that recall enough, the most first."""
        if len(file) < frames + 2:
            return []
        seen = file.read().observations
        if not bool((seen.depth > 0).any()):
            raise DataError(
                f"{file.path}: no frame has depth, which the protocol {self.name!r} needs to know what was seen "
                "before; evaluate it with --protocol return or long"
            )
        first = min(frames, len(file) - frames)  # short trajectories still have something before their clip
        starts = range(first, len(file) - frames + 1, max(1, (frames - 1) // 2))
        shares = {start: recalled_share(seen, start, start + frames - 1) for start in starts}
        enough = [start for start in starts if shares[start] >= LEAST_RECALLED]
        disjoint: list[int] = []
        for start in sorted(enough, key=lambda start: -shares[start]):
            if all(abs(start - previous) >= frames for previous in disjoint):
                disjoint.append(start)
        return disjoint

    def make_cases(self, chosen: list[tuple[int, int]], frames: int, search: ClipSearch) -> list[Case]:
        """Make the cases of (start, number of the trajectory), reading each trajectory once."""
        files = search.trajectories()
        cases: dict[tuple[int, int], Case] = {}
        for number in watched(list(dict.fromkeys(number for _, number in chosen)), "seen before", "trajectories"):
            seen = files[number].read().observations
            for start in (start for start, owner in chosen if owner == number):
                cases[start, number] = self.make_case(files[number], seen, (start, frames, start + 1), search)
        return [cases[place] for place in chosen]


class Unseen(Revisit):
    """The protocol ``revisit`` on data whose origin shows that the model was not trained on it."""

    name = "unseen"
    title = "Unseen houses and simulators"
    definition = (
        f"as revisit ({Revisit.definition}); no scene comes from the simulator's training split or from the model's "
        "training data, and each data set has a table of its own"
    )
    domains = True

    def find(self, search: ClipSearch) -> list[Case]:
        """Find the clips of each data set, up to the limit in each."""
        for file in search.trajectories():
            if file.info.source.get("split") == "train":
                raise DataError(f"{file.path}: its scene is of the training split; collect with --split test")
            if was_trained_on(file.info, search.training_scenes):
                raise DataError(f"{file.path}: the model was trained on its scene {file.info.scene!r}")
        cases: list[Case] = []
        for folder in search.folders:
            cases += super().find(dataclasses.replace(search, folders=[folder]))
        return cases


class Later(Revisit):
    """The protocol of one capture: its later frames are held out, and the memory is of all that came before."""

    name = "later"
    title = "Later frames of a capture"
    definition = (
        "clips of the frames at the end of each capture that are held out from training (`persist import --hold-out`), "
        "each beginning in the middle of the one before; memory of all true frames up to the first; nothing is written"
    )
    selections = ("all", "last", "new")

    def find(self, search: ClipSearch) -> list[Case]:
        """Find the clips of every capture in the order of its frames."""
        frames = search.frames or search.predicted_at_once + 1
        chosen = []
        for number, file in enumerate(search.trajectories()):
            first = file.info.source.get(HELD_OUT_FROM)
            if first is None:
                raise DataError(f"{file.path}: holds no frame out; import the capture with --hold-out 0.3")
            if was_trained_on(file.info, search.training_scenes, first):
                raise DataError(f"{file.path}: the model was trained on frames that are held out here")
            chosen += [(start, number) for start in range(first, len(file) - frames + 1, max(1, frames // 2))]
        if not chosen:
            raise DataError(f"{search.where}: no capture has {frames} frames held out; give --frames or hold out more")
        return self.make_cases(chosen[: search.limit], frames, search)


class ThereAndBack(Protocol):
    """The protocol of the paper's SRC: go somewhere and return by the reversed actions."""

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

    def find(self, search: ClipSearch) -> list[Case]:
        """Find one clip in each trajectory that turns round and comes back far enough, all of one length."""
        poses: dict[Path, Tensor] = {}
        turns: dict[Path, tuple[int, int]] = {}
        for file in watched(search.trajectories(), "turning points", "trajectories"):
            poses[file.path] = file.poses()
            turns[file.path] = turning_point(poses[file.path])
        lengths = sorted(length for _, length in turns.values() if length >= LEAST_RETURN_FRAMES)
        frames = search.frames or min(RETURN_FRAMES, lengths[len(lengths) // 2] if lengths else RETURN_FRAMES)
        cases: list[Case] = []
        for file in watched(search.trajectories(), "seen before", "trajectories"):
            twice, length = turns[file.path]
            if length < max(frames, LEAST_RETURN_FRAMES) or len(cases) == search.limit:
                continue
            start = (twice - frames + 1) // 2
            if goes_away(poses[file.path][start : start + frames]):
                cases.append(self.make_returning_case(file, start, frames, twice, search))
        if not cases:
            longest = max((length for _, length in turns.values()), default=0)
            raise DataError(
                f"{search.where}: no trajectory goes away and comes back by the same poses within {frames} "
                f"frames (the longest there and back has {longest}); collect with --policy there-and-back, or evaluate "
                "with --protocol revisit or long"
            )
        return cases

    def make_returning_case(
        self, file: TrajectoryFile, start: int, frames: int, twice: int, search: ClipSearch
    ) -> Case:
        """Make a case whose later frames return to its earlier ones; ``twice`` is that of ``turning_point``."""
        seen = file.read(slice(0, start + frames)).observations
        case = self.make_case(file, seen, (start, frames, 0), search)
        partners = [twice - (start + number) - start for number in range(frames)]
        visits = [earlier if 0 <= earlier < number - 1 else -1 for number, earlier in enumerate(partners)]
        return dataclasses.replace(case, first_visits=tuple(visits))


class Long(Protocol):
    """The protocol of the paper's long video: many clips one after the other from a single given frame."""

    name = "long"
    title = "Long rollout"
    definition = (
        f"at least {LEAST_LONG_FRAMES} frames predicted clip after clip from one given frame along the true path; the "
        "memory begins empty and is written with the given frame and the model's own output"
    )
    writes = True
    selections = ("all", "last")

    def find(self, search: ClipSearch) -> list[Case]:
        """Find disjoint clips from the beginning of each trajectory on."""
        frames = search.frames or LEAST_LONG_FRAMES + 1
        if frames <= LEAST_LONG_FRAMES:
            raise DataError(
                f"the protocol 'long' predicts at least {LEAST_LONG_FRAMES} frames; --frames {frames} are too few"
            )
        files = search.trajectories()
        places = [(file, start) for file in files for start in range(0, len(file) - frames + 1, frames)]
        if not places:
            longest = max(len(file) for file in files)
            raise DataError(
                f"{search.where}: no trajectory has {frames} frames, the longest has {longest}; "
                f"collect with --frames {frames}"
            )
        return [
            self.make_case(file, file.read(slice(0, start + frames)).observations, (start, frames, 0), search)
            for file, start in watched(places[: search.limit], "seen before", "clips")
        ]


PROTOCOLS: dict[str, Protocol] = {
    protocol.name: protocol for protocol in (Revisit(), ThereAndBack(), Long(), Unseen(), Later())
}


def turning_point(poses: Float[Tensor, "frame 4 4"]) -> tuple[int, int]:
    """Where a path mirrors itself the longest: twice the number of the turning frame, and frames of the mirrored part.

    Twice, because a path may turn between two frames.
    """
    best = (0, 0)
    for twice in range(1, 2 * len(poses) - 2):
        first, last = twice // 2, (twice + 1) // 2
        count = min(first + 1, len(poses) - last)
        same = same_poses(poses[first - count + 1 : first + 1].flip(0), poses[last : last + count])
        mirrored = count if bool(same.all()) else int((~same).nonzero()[0])
        length = 2 * mirrored - (1 if twice % 2 == 0 else 0)
        if length > best[1]:
            best = (twice, length)
    return best


def same_poses(first: Float[Tensor, "pose 4 4"], second: Float[Tensor, "pose 4 4"]) -> Bool[Tensor, " pose"]:
    """For each pair of poses whether they are the same."""
    metres, degrees = pose_differences(first, second)
    return (metres < SAME_METRES) & (degrees < SAME_DEGREES)


def goes_away(poses: Float[Tensor, "frame 4 4"]) -> bool:
    """Tell whether a path leaves its first pose far enough to ask for a memory."""
    metres, degrees = pose_differences(poses, poses[:1].expand_as(poses))
    return bool(((metres > AWAY_METRES) | (degrees > AWAY_DEGREES)).any())
