"""There and back by the reversed actions, the memory filled by the model's own output."""

from __future__ import annotations

import dataclasses

from jaxtyping import Bool, Float
from torch import Tensor

from persist_cli.evaluation.cases import Case
from persist_cli.evaluation.protocols.protocol import Protocol, Selected, names, trajectories
from persist_cli.trajectories.store import TrajectoryFile
from persist_cli.viewing.console import watched
from persist_cli.world.errors import DataError
from persist_cli.world.geometry import pose_differences

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
