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
    """What happens to every trajectory on its way in.

    Args:
        size: height and width in pixels, ``None`` to keep them.
        every: keep every n-th frame.
    """

    size: tuple[int, int] | None = None
    every: int = 1

    def info(self, info: TrajectoryInfo) -> TrajectoryInfo:
        """What holds for every frame after the change."""
        if self.every > 1:  # an action leads to the next frame only
            info = replace(info, vocabulary=free_motion(), source={**info.source, "every": self.every})
        return self._crop(info).info(info) if self.size else info

    def frames(self, trajectory: ForeignTrajectory) -> Iterator[Frame]:
        """The kept frames at their new size; the last one leads nowhere."""
        crop = self._crop(trajectory.info) if self.size else None
        last = self.length(trajectory) - 1
        for number, frame in enumerate(islice(trajectory.frames, 0, None, self.every)):
            action = None if number == last else FREE if self.every > 1 else frame.action
            kept = replace(frame, action=action)
            yield crop.frame(kept) if crop else kept

    def length(self, trajectory: ForeignTrajectory) -> int:
        """How many frames are kept."""
        return -(-trajectory.length // self.every)

    def _crop(self, info: TrajectoryInfo) -> CropResize:
        return crop_resize((info.height, info.width), self.size or (info.height, info.width))


def run_import(format: str, source: Path, out: Path, size: str | None, every: int, json: bool) -> None:
    """Import every trajectory of ``source`` that is not yet in ``out``.

    Args:
        format: an importer's name.
        size: ``HEIGHTxWIDTH`` in pixels, after a central crop to that aspect.
        every: keep every n-th frame.
    """
    plan = ImportPlan(parse_size(size) if size else None, every)
    importer = make_importer(format)
    if not source.exists():
        raise DataError(f"{source}: no such file or folder")
    rows = [_import(trajectory, plan, out) for trajectory in importer.trajectories(source)]
    if json:
        print_json({"out": str(out), "trajectories": rows})
        return
    columns = ("trajectory", "frames", "size", "state")
    table = [(row["name"], str(row["frames"]), f"{row['height']}×{row['width']}", row["state"]) for row in rows]
    print_table(str(out), columns, table)
    say(f"next: persist inspect {out}")


def _import(trajectory: ForeignTrajectory, plan: ImportPlan, out: Path) -> dict[str, Any]:
    """Write one trajectory unless it is there; what became of it."""
    path = out / f"{trajectory.name}{SUFFIX}"
    info = plan.info(trajectory.info)
    state = "already there"
    if not _is_there(path, info, plan.length(trajectory)):
        _write(path, info, trajectory, plan)
        state = "written"
    return {
        "name": trajectory.name,
        "frames": plan.length(trajectory),
        "height": info.height,
        "width": info.width,
        "state": state,
    }


def _is_there(path: Path, info: TrajectoryInfo, length: int) -> bool:
    """Whether an earlier run wrote this very trajectory; another one of that name is an error."""
    if not path.exists():
        return False
    there = TrajectoryFile(path)
    if there.length != length or schema(there.info).metadata != schema(info).metadata:
        raise DataError(f"{path}: holds another trajectory or one of other settings; remove it or take another --out")
    return True


def _write(path: Path, info: TrajectoryInfo, trajectory: ForeignTrajectory, plan: ImportPlan) -> None:
    for leftover in path.parent.glob(f"{ASIDE}*-{path.name}"):
        leftover.unlink(missing_ok=True)  # of a killed run
    with progress() as bar:
        task = add_task(bar, trajectory.name, plan.length(trajectory), "frames")

        def counted() -> Iterator[Frame]:
            for frame in plan.frames(trajectory):
                yield frame
                bar.advance(task)

        write_trajectory(path, info, counted())
