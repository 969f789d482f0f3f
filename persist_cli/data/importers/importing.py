"""``persist import``: foreign posed RGB-D into the store, trajectory by trajectory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

from persist_cli.api.actions import FREE, free_motion
from persist_cli.api.importer import ForeignTrajectory
from persist_cli.api.observations import Frame, TrajectoryInfo
from persist_cli.data.images import CropResize, crop_resize, parse_size
from persist_cli.data.store import SUFFIX, TrajectoryFile, schema, write_trajectory
from persist_cli.errors import DataError
from persist_cli.io.files import ASIDE
from persist_cli.plugins import make_importer
from persist_cli.viewing.console import add_task, print_json, print_table, progress, say


@dataclass(frozen=True)
class ImportPlan:
    """Changes made to every trajectory while it is imported.

    Args:
        size: height and width in pixels, ``None`` to keep them.
        every: keep every n-th frame.
    """

    size: tuple[int, int] | None = None
    every: int = 1

    def info(self, info: TrajectoryInfo) -> TrajectoryInfo:
        """The info of the imported trajectory."""
        if self.every > 1:  # the foreign actions lead to frames that are left out
            info = replace(info, vocabulary=free_motion(), source={**info.source, "every": self.every})
        return self._crop(info).info(info) if self.size else info

    def frames(self, trajectory: ForeignTrajectory) -> Iterator[Frame]:
        """The frames that are kept, at their new size; the last one has no action."""
        crop = self._crop(trajectory.info) if self.size else None
        last = self.length(trajectory) - 1
        for number, frame in enumerate(islice(trajectory.frames, 0, None, self.every)):
            action = None if number == last else FREE if self.every > 1 else frame.action
            frame = replace(frame, action=action)
            yield crop.frame(frame) if crop else frame

    def length(self, trajectory: ForeignTrajectory) -> int:
        """Number of frames that are kept."""
        return -(-trajectory.length // self.every)

    def _crop(self, info: TrajectoryInfo) -> CropResize:
        return crop_resize((info.height, info.width), self.size or (info.height, info.width))


def run_import(format: str, source: Path, out: Path, size: str | None, every: int, json: bool) -> None:
    """Import every trajectory of ``source`` that is not yet in ``out``, and print what there is.

    Args:
        format: name of an importer.
        source: folder or file of that format.
        out: data set folder.
        size: ``HEIGHTxWIDTH`` in pixels, after a central crop to that aspect.
        every: keep every n-th frame.
        json: print JSON instead of a table.

    Raises:
        PersistError: for an unknown format, a source that cannot be read, or a trajectory of other settings in ``out``.
    """
    plan = ImportPlan(parse_size(size) if size else None, every)
    importer = make_importer(format)
    if not source.exists():
        raise DataError(f"{source}: no such file or folder")
    rows = [import_trajectory(trajectory, plan, out) for trajectory in importer.trajectories(source)]
    if json:
        print_json({"out": str(out), "trajectories": rows})
        return
    columns = ("trajectory", "frames", "size", "state")
    table = [(row["name"], str(row["frames"]), f"{row['height']}×{row['width']}", row["state"]) for row in rows]
    print_table(str(out), columns, table)
    say(f"next: persist inspect {out}")


def import_trajectory(trajectory: ForeignTrajectory, plan: ImportPlan, out: Path) -> dict[str, Any]:
    """Write one trajectory unless it is there; name, frames, size and state are returned for the table."""
    path = out / f"{trajectory.name}{SUFFIX}"
    info = plan.info(trajectory.info)
    state = "already there"
    if not _is_imported(path, info, plan.length(trajectory)):
        _write(path, info, trajectory, plan)
        state = "written"
    return {
        "name": trajectory.name,
        "frames": plan.length(trajectory),
        "height": info.height,
        "width": info.width,
        "state": state,
    }


def _is_imported(path: Path, info: TrajectoryInfo, length: int) -> bool:
    """Whether an earlier run wrote this very trajectory; another one of that name is an error."""
    if not path.exists():
        return False
    file = TrajectoryFile(path)
    if file.length != length or schema(file.info).metadata != schema(info).metadata:
        raise DataError(f"{path}: holds another trajectory or one of other settings; remove it or take another --out")
    return True


def _write(path: Path, info: TrajectoryInfo, trajectory: ForeignTrajectory, plan: ImportPlan) -> None:
    for leftover in path.parent.glob(f"{ASIDE}*-{path.name}"):
        leftover.unlink(missing_ok=True)  # of a killed run
    with progress() as bar:
        task = add_task(bar, trajectory.name, plan.length(trajectory), "frames")

        def frames_with_progress() -> Iterator[Frame]:
            for frame in plan.frames(trajectory):
                yield frame
                bar.advance(task)

        write_trajectory(path, info, frames_with_progress())
