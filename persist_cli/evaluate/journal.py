"""The journal keeps every measured batch, so that a stopped evaluation goes on and several processes share one."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from persist_cli.data.mirror import fetched
from persist_cli.data.parquet import SUFFIX
from persist_cli.errors import DataError
from persist_cli.evaluate.cases import Case, hash_trajectories
from persist_cli.io.begun_with import check_same
from persist_cli.io.files import file_sha256, read_json, read_tensors, remove_leftovers, write_json, write_tensors

FOLDER = "parts"

PLAN, CASES, DATA, ROWS = "plan.json", "cases.json", "data.json", "rows.json"

TRUTH = -1  # stands for the true videos where a row's number is expected


@dataclass(frozen=True)
class Unit:
    """The smallest piece of work: one batch of one row at one sampling seed.

    Args:
        row: number of the row, or ``TRUTH``.
        seed: seed of the sampling noise.
        batch: number of the batch.
    """

    row: int
    seed: int
    batch: int

    @property
    def file(self) -> str:
        """Name of the file that keeps its figures and features."""
        row = "truth" if self.row == TRUTH else f"row-{self.row:03d}"
        return f"{row}-seed-{self.seed:03d}-batch-{self.batch:05d}.safetensors"


@dataclass(frozen=True)
class ExampleClip:
    """A clip of one row whose video the report shows.

    Args:
        row: number of the row.
        clip: number of the clip.
    """

    row: int
    clip: int

    @property
    def file(self) -> str:
        """Name of the file that keeps its video."""
        return f"shown-{self.row:03d}-clip-{self.clip:05d}.safetensors"


class Journal:
    """The files of an evaluation that is under way or finished.

    Args:
        out: folder of the evaluation.
    """

    def __init__(self, out: Path) -> None:
        self.folder = out / FOLDER

    @property
    def begun(self) -> bool:
        """Whether the folder holds an evaluation."""
        return (self.folder / PLAN).is_file()

    def check(self, plan: dict[str, Any]) -> None:
        """Raise ``PersistError`` when the folder holds another evaluation than this one."""
        if self.begun:
            check_same(read_json(self.folder / PLAN), plan, f"{self.folder.parent}: holds another evaluation")
        remove_leftovers(self.folder)

    def begin(self, plan: dict[str, Any], cases: Sequence[Case]) -> None:
        """Keep what is measured, on which clips of which files."""
        self.folder.mkdir(parents=True, exist_ok=True)
        write_json(self.folder / PLAN, plan)
        write_json(self.folder / DATA, hash_trajectories(cases))
        write_json(self.folder / CASES, [dataclasses.asdict(case) for case in cases])

    def cases(self) -> list[Case] | None:
        """The cases of the evaluation that was begun, ``None`` when none was."""
        if not ((self.folder / CASES).is_file() and (self.folder / DATA).is_file()):
            return None
        return [Case.from_json(values) for values in read_json(self.folder / CASES)]

    def data(self) -> list[dict[str, Any]]:
        """The data sets with the hashes of their trajectories at the beginning, see ``hash_trajectories``."""
        return list(read_json(self.folder / DATA))

    def check_data(self) -> None:
        """Raise ``DataError`` when a trajectory is no longer what it was when the evaluation began."""
        for folder in self.data():
            for name, digest in folder["trajectories"].items():
                path = Path(folder["path"]) / f"{name}{SUFFIX}"
                if not fetched(path).is_file():
                    raise DataError(
                        f"{path}: no such file, but the evaluation in {self.folder.parent} began with it; go on in the "
                        "folder where that one was begun, or choose another --out"
                    )
                if file_sha256(path) != digest:
                    raise DataError(
                        f"{path}: not what it was when the evaluation in {self.folder.parent} began; choose another "
                        "--out or delete that one"
                    )

    @property
    def names_rows(self) -> bool:
        """Whether it is kept which row has which number; earlier versions did not keep it."""
        return (self.folder / ROWS).is_file()

    def name_rows(self, names: Sequence[str]) -> None:
        """Keep the names of the rows by number; they may hold folders of checkpoints, which may be moved later.

        Raises:
            DataError: when there were more rows, or fewer, so that the numbers may mean others.
        """
        kept = len(read_json(self.folder / ROWS)) if self.names_rows else len(names)
        if kept != len(names):
            raise DataError(
                f"{self.folder.parent}: begun by an earlier version, with {kept} rows and not {len(names)}; choose "
                "another --out or delete it"
            )
        write_json(self.folder / ROWS, list(names))

    def has(self, part: Unit | ExampleClip) -> bool:
        """Whether a batch was measured, or a clip was predicted to be shown."""
        return (self.folder / part.file).is_file()

    def write(self, part: Unit | ExampleClip, tensors: dict[str, Tensor]) -> None:
        """Keep a batch's figures ``[clip, frame, metric]`` and features, or a clip's video, whole or not at all."""
        write_tensors(self.folder / part.file, tensors)

    def read(self, part: Unit | ExampleClip) -> dict[str, Tensor]:
        """The tensors that ``write`` kept."""
        return read_tensors(self.folder / part.file)[0]

    def gather(self, row: int, seed: int, batches: int, name: str) -> Tensor:
        """A tensor of every clip of a measured row at a seed, its batches one after the other."""
        return torch.cat([self.read(Unit(row, seed, batch))[name] for batch in range(batches)])
