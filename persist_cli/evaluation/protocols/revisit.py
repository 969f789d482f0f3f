"""Clips that look at places visited before, with a memory from earlier ground truth."""

from __future__ import annotations

from persist_cli.evaluation.cases import Case
from persist_cli.evaluation.protocols.protocol import Protocol, Selected, names, require_depth, trajectories
from persist_cli.evaluation.seen import GRID, recalled_share
from persist_cli.trajectories.store import TrajectoryFile
from persist_cli.viewing.console import watched
from persist_cli.world.errors import DataError

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
