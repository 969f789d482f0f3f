"""``persist import``: foreign posed RGB-D into the store, trajectory by trajectory."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

from persist_cli.api.actions import FREE, ActionVocabulary, free_motion
from persist_cli.api.importer import ForeignTrajectory, Importer
from persist_cli.api.observations import Frame, TrajectoryInfo
from persist_cli.data.held_out import HELD_OUT_FROM, ONLY_BEFORE
from persist_cli.data.images import CropResize, crop_resize
from persist_cli.data.importers.checking import checked_trajectories
from persist_cli.data.importers.gravity import FROM_CAMERAS, GIVEN, Direction, up_text
from persist_cli.data.parquet import SUFFIX
from persist_cli.data.store import TrajectoryFile, write_trajectory
from persist_cli.data.store_header import schema
from persist_cli.errors import DataError
from persist_cli.io.command_line import quoted
from persist_cli.io.files import check_folder, remove_leftovers
from persist_cli.output.console import add_task, print_json, print_table, progress, say, warn
from persist_cli.plugins import find_plugin, make_importer

MOST_CAUSES = 3  # that are printed for a trajectory
ABANDONED = 600.0  # seconds without a change after which what an import wrote is no longer being written


class NothingUsableError(DataError):
    """A trajectory in which too few frames can be used."""


@dataclass(frozen=True, kw_only=True)
class ImportPlan:
    """Changes made to every trajectory while it is imported.

    Args:
        size: height and width in pixels, ``None`` to keep them.
        every: keep every n-th frame.
        step: metres of a step of walking actions to add, ``None`` for the usual one, or for no such actions.
        turn: degrees of a turn of walking actions to add, as ``step``.
        skip_bad: leave out frames that cannot be used, and trajectories without enough others.
        hold_out: share of the frames at the end of each trajectory that are kept for tests; 0 for none.
        part: ``train`` for the frames before those, ``test`` for all, of which those at the end are held out.
        up: unit vector that points up in the world, ``None`` for the one of the importer.
        usable: number of the kept frames of the trajectory that can be used, where that was counted: where frames are
            held out and bad ones left out.
    """

    size: tuple[int, int] | None = None
    every: int = 1
    step: float | None = None
    turn: float | None = None
    skip_bad: bool = False
    hold_out: float = 0.0
    part: str = ""
    up: Direction | None = None
    usable: int | None = None

    def parts(self, out: Path) -> list[tuple[ImportPlan, Path]]:
        """What is written and where: all into ``out``, or with frames held out a test and a training part into it.

        The test part comes first: it is read to the end, so that nothing is written where a frame is bad.
        """
        if not self.hold_out:
            return [(self, out)]
        return [(replace(self, part=part), out / part) for part in ("test", "train")]

    def first_held_out(self, trajectory: ForeignTrajectory) -> int:
        """Number of the first kept frame that is held out.

        Raises:
            NothingUsableError: when nothing would be left on one of the sides.
        """
        length = self.length(trajectory)
        first = length - round(length * self.hold_out)
        if not 0 < first < length:
            raise NothingUsableError(
                f"{trajectory.name}: --hold-out {self.hold_out:g} of {length} frames leaves a part empty"
            )
        return first

    def source(self, trajectory: ForeignTrajectory) -> dict[str, Any]:
        """What the source of the imported trajectory says of the frames that are held out."""
        if not self.part:
            return {}
        key = ONLY_BEFORE if self.part == "train" else HELD_OUT_FROM
        return {"split": self.part, key: self.first_held_out(trajectory)}

    def info(self, info: TrajectoryInfo) -> TrajectoryInfo:
        """The info of the imported trajectory."""
        info = replace(info, vocabulary=self._vocabulary(info.vocabulary))
        if self.up is not None and not str(info.source.get("world_up", "")).startswith(GIVEN):
            info = replace(info, world_up=self.up, source={**info.source, "world_up": GIVEN})
        if self.every > 1:
            info = replace(info, source={**info.source, "every": self.every})
        if self.skip_bad:
            info = replace(info, source={**info.source, "skip_bad": True})
        return self._crop(info).info(info) if self.size else info

    def frames(self, trajectory: ForeignTrajectory, left_out: list[DataError]) -> Iterator[Frame]:
        """Yield the frames that are kept, at their new size.

        An action that leads over a frame that is left out becomes ``free``: what is named is one step to the next
        frame. The last frame has no action. Times stay as they were.

        Args:
            trajectory: what is imported.
            left_out: gets the cause of each bad frame that is left out.

        Raises:
            DataError: for a bad frame, unless bad frames are left out; ``NothingUsableError`` when all are.
        """
        crop = self._crop(trajectory.info) if self.size else None
        most = self.written(trajectory)
        last, gap, kept = None, False, 0
        for frame in islice(trajectory.frames, 0, None, self.every):
            if isinstance(frame, DataError):
                if not self.skip_bad:
                    raise DataError(f"{frame}; --skip-bad leaves such frames out") from frame
                left_out.append(frame)
                gap = True
                continue
            if kept == most:
                for _ in trajectory.frames:  # held-out ones: that they are as many as was said is checked with them
                    pass
                break
            kept += 1
            if last is not None:
                yield replace(last, action=FREE if gap or self.every > 1 else last.action)
            last, gap = crop.frame(frame) if crop else frame, False
        if last is None and left_out:
            raise NothingUsableError(f"{trajectory.name}: none of its frames can be used; {left_out[0]}")
        if last is not None:
            yield replace(last, action=None)

    def count_usable(self, trajectory: ForeignTrajectory) -> int:
        """Read the trajectory's frames, and return how many of those that are looked at can be used.

        Raises:
            NothingUsableError: when no frame can be used.
        """
        causes: list[DataError] = []
        with progress() as bar:
            task = add_task(bar, f"checking {trajectory.name}", self.chosen(trajectory), "frames")
            for frame in islice(trajectory.frames, 0, None, self.every):
                causes += [frame] if isinstance(frame, DataError) else []
                bar.advance(task)
        usable = self.chosen(trajectory) - len(causes)
        if not usable:
            raise NothingUsableError(f"{trajectory.name}: none of its frames can be used; {causes[0]}")
        return usable

    def chosen(self, trajectory: ForeignTrajectory) -> int:
        """Number of frames that are looked at, bad ones included."""
        return -(-trajectory.length // self.every)

    def length(self, trajectory: ForeignTrajectory) -> int:
        """Number of frames that are kept, when none is bad or as counted."""
        return self.chosen(trajectory) if self.usable is None else self.usable

    def written(self, trajectory: ForeignTrajectory) -> int:
        """Number of frames of this part, when none is bad or as counted."""
        return self.first_held_out(trajectory) if self.part == "train" else self.length(trajectory)

    def _vocabulary(self, own: ActionVocabulary) -> ActionVocabulary:
        """The foreign actions, or ``free`` where they lead to frames that are left out, and walking ones if wanted."""
        vocabulary = free_motion() if self.every > 1 else own
        if self.skip_bad and FREE not in vocabulary.names:
            vocabulary = ActionVocabulary((*vocabulary.actions, *free_motion().actions))
        if self.step is None and self.turn is None:
            return vocabulary
        if vocabulary.can_walk:
            raise DataError(f"--step and --turn: the frames have actions of their own, {vocabulary.listing()}")
        return vocabulary.walking(self.step, self.turn)

    def _crop(self, info: TrajectoryInfo) -> CropResize:
        return crop_resize((info.height, info.width), self.size or (info.height, info.width))


def run_import(
    format: str, source: Path, out: Path, plan: ImportPlan, json: bool, settings: Mapping[str, Any] | None = None
) -> None:
    """Import every trajectory of ``source`` that is not yet in ``out``, and print what there is.

    Args:
        format: name of an importer.
        source: folder or file of that format.
        out: data set folder.
        plan: changes to every trajectory.
        json: print JSON instead of a table.
        settings: plain settings of the importer.

    Raises:
        PersistError: for an unknown format or a broken importer, a source that cannot be read, or a trajectory of other
            settings in ``out``.
    """
    importer = make_importer(format, dict(settings or {}))
    importer.up = plan.up
    check_folder(out)
    if not source.exists():
        raise DataError(f"{source}: no such file or folder")
    if not 0 <= plan.hold_out < 1:
        raise DataError(f"--hold-out {plan.hold_out:g}: give a share of the frames, 0 or more and below 1, as in 0.3")
    rows, left_out = import_trajectories(importer, source, out, plan)
    unsure = [row["name"] for row in rows if row["world_up_is"].startswith(FROM_CAMERAS)]
    if unsure:
        warn(
            f"no level surface was found in {', '.join(unsure)}: up is only guessed from how people hold cameras; "
            "if it is wrong, give --up X,Y,Z and a new --out"
        )
    if json:
        print_json({"out": str(out), "trajectories": rows, "left_out": left_out})
        return
    columns = ("trajectory", "frames", "left out", "size", "up", "state")
    print_table(str(out), columns, [_cells(row) for row in rows])
    for row in rows:
        if row["causes"]:
            rest = row["left_out"] - len(row["causes"])
            say(f"left out of {row['name']}: {'; '.join(row['causes'])}{f'; and {rest} more' if rest else ''}")
    for cause in left_out:
        say(f"left out: {cause}")
    say(f"next: persist inspect {quoted(plan.parts(out)[0][1])}")


def import_trajectories(
    importer: Importer, source: Path, out: Path, plan: ImportPlan
) -> tuple[list[dict[str, Any]], list[str]]:
    """Import every trajectory of ``source`` that is not yet in ``out``.

    Returns:
        What the table says of each, and why others were left out.

    Raises:
        DataError: for what cannot be used, unless that is left out; and when all trajectories are.
    """
    causes: dict[str, None] = {}  # each once, though the source is read for each part
    usable: dict[str, int] | None = None
    if plan.hold_out and plan.skip_bad:  # the share that is held out is one of the usable frames
        usable = {}
        for trajectory in _whole(importer, source, plan, causes):
            with _left_out(plan, causes):
                count = plan.count_usable(trajectory)
                replace(plan, usable=count).first_held_out(trajectory)
                usable[trajectory.name] = count
    written: list[list[dict[str, Any]]] = []
    for part, folder in plan.parts(out):
        written.append([])
        for trajectory in _whole(importer, source, plan, causes):
            if usable is not None and trajectory.name not in usable:
                continue
            part_of_it = part if usable is None else replace(part, usable=usable[trajectory.name])
            with _left_out(plan, causes):
                written[-1].append(import_trajectory(importer, trajectory, part_of_it, folder))
    rows = [row for part in reversed(written) for row in part]
    if not rows:
        raise DataError(f"nothing of {source} can be used; {next(iter(causes))}")
    return rows, list(causes)


def _whole(importer: Importer, source: Path, plan: ImportPlan, causes: dict[str, None]) -> Iterator[ForeignTrajectory]:
    """Yield the trajectories that can be used; why others cannot is put into ``causes``, or raised."""
    several = False
    for trajectory in checked_trajectories(importer, source):
        if not isinstance(trajectory, DataError):
            yield trajectory
        elif plan.skip_bad:
            causes[str(trajectory)] = None
        else:
            raise DataError(f"{trajectory}{'; --skip-bad leaves such trajectories out' * several}") from trajectory
        several = True


@contextlib.contextmanager
def _left_out(plan: ImportPlan, causes: dict[str, None]) -> Iterator[None]:
    """Within the block a trajectory of which too little can be used is left out if asked; ``causes`` gets why."""
    try:
        yield
    except NothingUsableError as error:
        if not plan.skip_bad:
            raise
        causes[str(error)] = None


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    """What the table shows of an imported trajectory."""
    size, up = f"{row['height']}×{row['width']}", up_text(row["world_up"])
    return row["name"], str(row["frames"]), str(row["left_out"]), size, up, row["state"]


def import_trajectory(importer: Importer, trajectory: ForeignTrajectory, plan: ImportPlan, out: Path) -> dict[str, Any]:
    """Write one trajectory unless it is there, and return what the table says of it."""
    path = out / f"{trajectory.name}{SUFFIX}"
    info = plan.info(trajectory.info)
    info = replace(info, source=info.source | plan.source(trajectory))
    state, left_out = "already there", list[DataError]()
    if not _is_imported(path, info, plan, trajectory):
        frames = _checked(plan.frames(trajectory, left_out), info, importer)
        _write(path, info, plan.written(trajectory), frames)
        state = "written"
    length = TrajectoryFile(path).length
    looked_at = plan.written(trajectory) if plan.part == "train" else plan.chosen(trajectory)
    return {
        "name": f"{out.name}/{trajectory.name}" if plan.part else trajectory.name,
        "frames": length,
        # later frames take the places of those that are left out of the training part
        "left_out": len(left_out) if state == "written" else max(0, looked_at - length),
        "causes": [str(cause) for cause in left_out[:MOST_CAUSES]],
        "height": info.height,
        "width": info.width,
        "world_up": info.world_up,
        "world_up_is": info.source.get("world_up", "from the importer"),
        "state": state,
    }


def _checked(frames: Iterator[Frame], info: TrajectoryInfo, importer: Importer) -> Iterator[Frame]:
    """Yield the frames; ``PluginError`` naming the importer for an action that is not in the vocabulary."""
    for number, frame in enumerate(frames):
        if frame.action is not None and frame.action not in info.vocabulary.names:
            cause = (
                f"frame {number} takes the action {frame.action!r}, which its vocabulary "
                f"({', '.join(info.vocabulary.names)}) does not have"
            )
            raise find_plugin("importer", importer.name).error(f"is broken: {cause}", cause)
        yield frame


def _is_imported(path: Path, info: TrajectoryInfo, plan: ImportPlan, trajectory: ForeignTrajectory) -> bool:
    """Whether an earlier run wrote this very trajectory; another one of that name is an error."""
    if not path.exists():
        return False
    file = TrajectoryFile(path)
    most = plan.written(trajectory)
    length_fits = 0 < file.length <= most if plan.skip_bad else file.length == most
    infos = [info]
    if plan.skip_bad and file.length == most:  # nothing was left out, so that it may have been written without
        kept = replace(plan, skip_bad=False)
        whole = kept.info(trajectory.info)
        infos.append(replace(whole, source=whole.source | kept.source(trajectory)))
    if not length_fits or schema(file.info).metadata not in [schema(one).metadata for one in infos]:
        other = "holds another trajectory, one of other settings, or files have changed"
        raise DataError(f"{path}: {other}; remove it or take another --out")
    return True


def _write(path: Path, info: TrajectoryInfo, length: int, frames: Iterator[Frame]) -> None:
    remove_leftovers(path.parent, path.name, age=ABANDONED)
    with progress() as bar:
        task = add_task(bar, path.name.removesuffix(SUFFIX), length, "frames")

        def frames_with_progress() -> Iterator[Frame]:
            for frame in frames:
                yield frame
                bar.advance(task)

        write_trajectory(path, info, frames_with_progress())
