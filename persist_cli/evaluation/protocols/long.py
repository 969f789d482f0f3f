"""Long rollouts: quality against frame number."""

from __future__ import annotations

from persist_cli.evaluation.cases import Case
from persist_cli.evaluation.protocols.protocol import Protocol, Selected, names, trajectories
from persist_cli.viewing.console import watched
from persist_cli.world.errors import DataError

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
