"""Protocols: which clips are predicted, and what the memory holds when they begin."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal, TypeVar

from jaxtyping import Bool, Float
from torch import Tensor

from persist_cli.api.geometry import pose_differences
from persist_cli.api.observations import Observations
from persist_cli.checkpoints.contamination import OTHER_DATA, ShownScene, refuse_training_scenes
from persist_cli.data.held_out import HELD_OUT_FROM
from persist_cli.data.store import Store, TrajectoryFile
from persist_cli.errors import DataError
from persist_cli.evaluate.cases import Case
from persist_cli.evaluate.coverage import GRID, held_frames, recalled_share, seen_share
from persist_cli.evaluate.new_poses import NEW_POSES, RETURN_DEGREES, RETURN_METRES, NewPoses, returning_frames
from persist_cli.output.console import watched

T = TypeVar("T")

FrameSelection = Literal["all", "last", "return", "new", "seen"]  # frames of a clip that a column is the mean over

LEAST_RECALLED = 0.3  # share of the last view seen earlier and not from the clip's first frame

SAME_METRES, SAME_DEGREES = 0.02, 2.0  # two poses that differ by less are the same pose

AWAY_METRES, AWAY_DEGREES = 0.5, 45.0  # a path must exceed one of them before it returns

RETURN_FRAMES = 49  # of a clip that returns, when half of the trajectories come back that far

LEAST_RETURN_FRAMES = 5

LEAST_RETURNING = 8  # at least one in so many frames of a clip comes back by another way

START_STRIDE = 4  # frames between the starts of clips that are tried

LEAST_LONG_FRAMES = 112  # frames to predict, as in the paper


@dataclass(frozen=True, kw_only=True)
class ClipSearch:
    """Where a protocol looks for clips, and how long and how many they are.

    Args:
        folders: the data sets.
        frames: length of a clip, the given frame included; 0 takes the protocol's own number.
        limit: greatest number of clips.
        predicted_at_once: frames that the backbone predicts at once.
        training_scenes: names of scenes that a model is known to have been trained on.
        new_poses: which frames count.
    """

    folders: Sequence[Path]
    frames: int
    limit: int
    predicted_at_once: int
    training_scenes: frozenset[str] = frozenset()
    new_poses: NewPoses = NEW_POSES

    @property
    def where(self) -> str:
        """The data sets for an error message."""
        return ", ".join(map(str, self.folders))

    def trajectories(self) -> list[TrajectoryFile]:
        """Every trajectory of the data sets, in order."""
        return [file for folder in self.folders for file in Store(folder)]

    def in_turns(self, found: Sequence[Sequence[T]]) -> list[T]:
        """All that was found, taking turns over the data sets and, in each, over its trajectories.

        So the first ones are of as many data sets, and of as many houses, as can be.

        Args:
            found: what was found in each of ``trajectories()``, the first to be taken first.
        """
        parts = iter(found)
        return take_turns([take_turns([next(parts) for _ in Store(folder)]) for folder in self.folders])


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

    def first_scored(self, file: TrajectoryFile) -> int:
        """The number of the first frame of a trajectory that may be predicted."""
        return 0

    def check_scenes(self, search: ClipSearch, way_out: str = OTHER_DATA) -> None:
        """Raise ``DataError`` when a model was trained on what a data set shows from its first scored frame on.

        Args:
            search: names the data sets and the training scenes.
            way_out: what the user may do, the end of the message.
        """
        shown = (ShownScene.of(file, self.first_scored(file)) for file in search.trajectories())
        refuse_training_scenes(shown, search.training_scenes, way_out)

    def make_case(
        self, file: TrajectoryFile, seen: Observations, where: tuple[int, int, int], search: ClipSearch
    ) -> Case:
        """Make a case that returns to no earlier place.

        Args:
            file: the trajectory.
            seen: the frames of the trajectory, at least up to the clip's last.
            where: number of the clip's first frame, frames of the clip, frames of context.
            search: says how many frames are predicted at once.
        """
        start, frames, context = where
        held = [held_frames(start, context, frame, search.predicted_at_once, self.writes) for frame in range(frames)]
        shares = [seen_share(seen, start + frame, numbers) for frame, numbers in enumerate(held)]
        poses = seen.cameras.world_from_camera
        return Case(
            data=str(file.path.parent),
            trajectory=file.name,
            scene=file.info.scene,
            start=start,
            frames=frames,
            context=context,
            seen_before=tuple(shares),
            first_visits=(-1,) * frames,
            counted=search.new_poses.counted(poses, start, held),
        )


class Revisit(Protocol):
    """The protocol of the paper's Table 1: the memory holds every true frame before the clip."""

    name = "revisit"
    title = "Places seen before"
    definition = (
        f"at least {LEAST_RECALLED:.0%} of the clip's last view (a grid of {GRID}×{GRID} pixels) was seen by frames "
        "before the clip and not from its first frame, and most of its frames count, the last among them; memory of "
        "all true frames up to the first; nothing is written"
    )
    writes = False
    selections = ("all", "last", "new", "seen")

    def find(self, search: ClipSearch) -> list[Case]:
        """Find the clips with the most to recall, taking turns as ``in_turns`` does, disjoint in each trajectory."""
        frames = search.frames or search.predicted_at_once + 1
        files = watched(search.trajectories(), "what returns", "trajectories")
        ranked = [self.rank_starts(file, frames, search.new_poses) for file in files]
        chosen = search.in_turns([[(start, number) for start in starts] for number, starts in enumerate(ranked)])
        if not chosen:
            raise DataError(
                f"{search.where}: no clip of {frames} frames returns to a place seen before, by poses that are new; "
                "collect with --policy loop or longer trajectories, give smaller limits where a camera moves little "
                "between frames (--new-poses 0.05 3), or evaluate with --protocol long"
            )
        return self.make_cases(chosen[: search.limit], frames, search)

    def rank_starts(self, file: TrajectoryFile, frames: int, new_poses: NewPoses) -> list[int]:
        """Starts of disjoint clips of one trajectory that recall enough at poses that are new, the most first."""
        if len(file) < frames + 2:
            return []
        seen = file.read().observations
        if not bool((seen.depth > 0).any()):
            raise DataError(
                f"{file.path}: no frame has depth, which the protocol {self.name!r} needs to know what was seen "
                "before; evaluate it with --protocol return or long"
            )
        first = min(frames, len(file) - frames)  # short trajectories still have something before their clip
        every = range(first, len(file) - frames + 1, max(1, (frames - 1) // 2))
        starts = [start for start in every if mostly_new(seen.cameras.world_from_camera, start, frames, new_poses)]
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

    def check_scenes(self, search: ClipSearch, way_out: str = "") -> None:
        """Raise ``DataError`` when a model was trained on a scene; there is no way out but other data."""
        super().check_scenes(search)

    def find(self, search: ClipSearch) -> list[Case]:
        """Find the clips of each data set, up to the limit in each."""
        for file in search.trajectories():
            if file.info.source.get("split") == "train":
                raise DataError(f"{file.path}: its scene is of the training split; collect with --split test")
        self.check_scenes(search)
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
    selections = ("all", "last", "new", "seen")

    def first_scored(self, file: TrajectoryFile) -> int:
        """The number of the first frame that is held out."""
        return int(file.info.source.get(HELD_OUT_FROM, 0))

    def find(self, search: ClipSearch) -> list[Case]:
        """Find the clips of each capture in the order of its frames, taking turns as ``in_turns`` does."""
        frames = search.frames or search.predicted_at_once + 1
        found = []
        for number, file in enumerate(search.trajectories()):
            first = file.info.source.get(HELD_OUT_FROM)
            if first is None:
                raise DataError(f"{file.path}: holds no frame out; import the capture with --hold-out 0.3")
            found.append([(start, number) for start in range(first, len(file) - frames + 1, max(1, frames // 2))])
        chosen = search.in_turns(found)
        if not chosen:
            raise DataError(f"{search.where}: no capture has {frames} frames held out; give --frames or hold out more")
        return self.make_cases(chosen[: search.limit], frames, search)


class ThereAndBack(Protocol):
    """The protocol of returns: go somewhere and come back, by another way or by the reversed actions."""

    name = "return"
    title = "There and back"
    definition = (
        f"a frame returns if its pose is within {RETURN_METRES:g} m and {RETURN_DEGREES:g}° of an earlier frame that "
        "is in memory when it is predicted, over more than one predicted clip and after the camera was farther from "
        "that one; the nearest is its first visit; the memory begins empty and is written with the given frame and the "
        "model's own output"
    )
    writes = True
    selections = ("all", "return")
    guards = ("copy", "truth")  # a frozen video has the best SRC, the truth not quite

    def find(self, search: ClipSearch) -> list[Case]:
        """Find one clip in each trajectory that comes back, all of one length, taking turns over the data sets."""
        found: dict[Path, tuple[Tensor, int, int]] = {}
        files = search.in_turns([[file] for file in search.trajectories()])
        for file in watched(files, "what comes back", "trajectories"):
            poses = file.poses()
            found[file.path] = (poses, *turning_point(poses))
        frames = search.frames or self.usual_frames(list(found.values()), search)
        cases: list[Case] = []
        for file in watched(files, "seen before", "trajectories"):
            poses, twice, length = found[file.path]
            if len(cases) == search.limit or len(poses) < max(frames, LEAST_RETURN_FRAMES):
                continue
            start: int | None = (twice - frames + 1) // 2 if length >= frames else None
            if start is None or not goes_away(poses[start : start + frames]):
                start = best_start(poses, frames, search)
            if start is not None and goes_away(poses[start : start + frames]):
                cases.append(self.make_returning_case(file, start, frames, search))
        if not cases:
            raise DataError(
                f"{search.where}: no trajectory goes away and comes back within {frames} frames; collect with --policy "
                "loop (another way) or there-and-back (the same poses), or evaluate with --protocol revisit or long"
            )
        return cases

    def usual_frames(self, found: Sequence[tuple[Tensor, int, int]], search: ClipSearch) -> int:
        """The length of a clip with which half of the trajectories that come back have one.

        Args:
            found: for each trajectory its poses, and what ``turning_point`` says of them.
            search: says how many frames are predicted at once and which count.
        """
        lengths = [
            len(poses) if best_start(poses, len(poses), search) is not None else mirrored
            for poses, _, mirrored in found
        ]
        enough = sorted(length for length in lengths if length >= LEAST_RETURN_FRAMES)
        return min(RETURN_FRAMES, enough[len(enough) // 2]) if enough else RETURN_FRAMES

    def make_returning_case(self, file: TrajectoryFile, start: int, frames: int, search: ClipSearch) -> Case:
        """Make a case whose later frames return to its earlier ones."""
        seen = file.read(slice(0, start + frames)).observations
        case = self.make_case(file, seen, (start, frames, 0), search)
        poses = seen.cameras.world_from_camera[start:]
        return dataclasses.replace(case, first_visits=returning_frames(poses, visits_before(frames, search)))


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
        """Find disjoint clips from the beginning of each trajectory on, taking turns as ``in_turns`` does."""
        frames = search.frames or LEAST_LONG_FRAMES + 1
        if frames <= LEAST_LONG_FRAMES:
            raise DataError(
                f"the protocol 'long' predicts at least {LEAST_LONG_FRAMES} frames; --frames {frames} are too few"
            )
        files = search.trajectories()
        starts = [range(0, len(file) - frames + 1, frames) for file in files]
        places = search.in_turns([[(file, start) for start in own] for file, own in zip(files, starts, strict=True)])
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


def take_turns(queues: Sequence[Sequence[T]]) -> list[T]:
    """The first of each queue, then the second of each, and so on; a queue that has ended is passed over."""
    turns = range(max(map(len, queues), default=0))
    return [queue[turn] for turn in turns for queue in queues if turn < len(queue)]


def turning_point(poses: Float[Tensor, "frame 4 4"]) -> tuple[int, int]:
    """Where a path mirrors itself the longest: twice the number of the turning frame, and frames of the mirrored part.

    Twice, because a path may turn between two frames. Where the camera stands still nothing is mirrored.
    """
    best = (0, 0)
    for twice in range(1, 2 * len(poses) - 2):
        first, last = twice // 2, (twice + 1) // 2
        count = min(first + 1, len(poses) - last)
        same = same_poses(poses[first - count + 1 : first + 1].flip(0), poses[last : last + count])
        mirrored = count if bool(same.all()) else int((~same).nonzero()[0])
        length = 2 * mirrored - (1 if twice % 2 == 0 else 0)
        begin = first - mirrored + 1
        if length > best[1] and goes_away(poses[begin : begin + length]):
            best = (twice, length)
    return best


def best_start(poses: Float[Tensor, "frame 4 4"], frames: int, search: ClipSearch) -> int | None:
    """The first frame of the clip with the most frames that return and count; ``None`` where too few do."""
    most, best = max(1, frames // LEAST_RETURNING) - 1, None
    for start in range(0, len(poses) - frames + 1, START_STRIDE):
        clip = poses[start : start + frames]
        held = held_in_clip(frames, search)
        counted, visits = search.new_poses.counted(clip, 0, held), returning_frames(clip, visits_before(frames, search))
        count = sum(new and earlier >= 0 for new, earlier in zip(counted, visits, strict=True))
        if count > most:
            most, best = count, start
    return best


def held_in_clip(frames: int, search: ClipSearch) -> list[list[int]]:
    """For each frame of a clip the numbers in it of the frames in memory, which begins empty and is written."""
    return [held_frames(0, 0, frame, search.predicted_at_once, writes=True) for frame in range(frames)]


def visits_before(frames: int, search: ClipSearch) -> list[list[int]]:
    """For each frame of a clip the numbers of those in memory over more than one predicted clip before it."""
    held = enumerate(held_in_clip(frames, search))
    return [[number for number in numbers if frame - number > search.predicted_at_once] for frame, numbers in held]


def mostly_new(poses: Float[Tensor, "frame 4 4"], start: int, frames: int, new_poses: NewPoses) -> bool:
    """Whether the last frame and at least half of a clip count, where memory holds every frame up to the first."""
    counted = new_poses.counted(poses, start, [range(start + 1)] * frames)
    return counted[-1] and sum(counted[1:]) >= (frames - 1) / 2


def same_poses(first: Float[Tensor, "pose 4 4"], second: Float[Tensor, "pose 4 4"]) -> Bool[Tensor, " pose"]:
    """For each pair of poses whether they are the same."""
    metres, degrees = pose_differences(first, second)
    return (metres < SAME_METRES) & (degrees < SAME_DEGREES)


def goes_away(poses: Float[Tensor, "frame 4 4"]) -> bool:
    """Tell whether a path leaves its first pose far enough to ask for a memory."""
    metres, degrees = pose_differences(poses, poses[:1].expand_as(poses))
    return bool(((metres > AWAY_METRES) | (degrees > AWAY_DEGREES)).any())
