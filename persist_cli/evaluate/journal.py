"""The processes of ``accelerate launch`` that share an evaluation; one without it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch
from accelerate import PartialState
from torch import Tensor

from persist_cli.data.store import SUFFIX
from persist_cli.errors import DataError, PersistError
from persist_cli.evaluate.cases import Case, data_files
from persist_cli.io.files import (
    file_sha256,
    read_json,
    read_tensors,
    remove_leftovers,
    write_json,
    write_tensors,
)

LONGEST = timedelta(days=7)  # a process may wait this long for the slowest


class Processes:
    """This process among those of the run."""

    def __init__(self) -> None:
        self.state = PartialState(cpu=not torch.cuda.is_available(), timeout=LONGEST)

    @property
    def count(self) -> int:
        """How many there are."""
        return int(self.state.num_processes)

    @property
    def main(self) -> bool:
        """Whether this one finds the clips and writes the results."""
        return bool(self.state.is_main_process)

    def mine(self, number: int) -> bool:
        """Whether a batch is this process's to measure; batches are the same for any number of processes."""
        return number % self.count == int(self.state.process_index)

    def wait(self) -> None:
        """Until every process is here."""
        self.state.wait_for_everyone()


FOLDER = "parts"

PLAN, CASES, DATA = "plan.json", "cases.json", "data.json"

TRUTH = -1  # in the place of a row's number: the true videos


@dataclass(frozen=True)
class Unit:
    """One batch of one row at one seed.

    Args:
        row: its number, or ``TRUTH``.
        seed: of the sampling noise.
        batch: its number.
    """

    row: int
    seed: int
    batch: int

    @property
    def file(self) -> str:
        """Where it is kept."""
        row = "truth" if self.row == TRUTH else f"row-{self.row:03d}"
        return f"{row}-seed-{self.seed:03d}-batch-{self.batch:05d}.safetensors"


@dataclass(frozen=True)
class Shown:
    """One clip of a row that the report shows.

    Args:
        row: its number.
        clip: its number.
    """

    row: int
    clip: int

    @property
    def file(self) -> str:
        """Where it is kept."""
        return f"shown-{self.row:03d}-clip-{self.clip:05d}.safetensors"


class Journal:
    """The folder of an evaluation's parts.

    Args:
        out: the evaluation's folder.
    """

    def __init__(self, out: Path) -> None:
        self.folder = out / FOLDER

    @property
    def begun(self) -> bool:
        """Whether the folder holds an evaluation."""
        return (self.folder / PLAN).is_file()

    def check(self, plan: dict[str, Any]) -> None:
        """Raise ``PersistError`` when the folder holds another evaluation than this one."""
        there = read_json(self.folder / PLAN) if self.begun else plan
        if there != plan:
            raise PersistError(
                f"{self.folder.parent}: holds another evaluation ({different(there, plan)}); choose another --out or "
                "delete it"
            )
        remove_leftovers(self.folder)

    def begin(self, plan: dict[str, Any], cases: Sequence[Case]) -> None:
        """Keep what is measured, on which clips of which files."""
        self.folder.mkdir(parents=True, exist_ok=True)
        write_json(self.folder / PLAN, plan)
        write_json(self.folder / DATA, data_files(cases))
        write_json(self.folder / CASES, [dataclasses.asdict(case) for case in cases])

    def cases(self) -> list[Case] | None:
        """The cases, when they were found before."""
        if not ((self.folder / CASES).is_file() and (self.folder / DATA).is_file()):
            return None
        return [Case.from_json(each) for each in read_json(self.folder / CASES)]

    def data(self) -> list[dict[str, Any]]:
        """The data sets with the hashes of the trajectories, as ``data_files`` gave them at the beginning."""
        return list(read_json(self.folder / DATA))

    def check_data(self) -> None:
        """Raise ``DataError`` when a trajectory is no longer what it was when the evaluation began."""
        for folder in self.data():
            for name, digest in folder["trajectories"].items():
                path = Path(folder["path"]) / f"{name}{SUFFIX}"
                if not path.is_file() or file_sha256(path) != digest:
                    raise DataError(
                        f"{path}: not what it was when the evaluation in {self.folder.parent} began; choose another "
                        "--out or delete that one"
                    )

    def has(self, part: Unit | Shown) -> bool:
        """Whether a batch was measured, or a clip predicted to be shown."""
        return (self.folder / part.file).is_file()

    def write(self, part: Unit | Shown, tensors: dict[str, Tensor]) -> None:
        """Keep a batch's figures ``[clip, frame, metric]`` and features, or a clip's video, whole or not at all."""
        write_tensors(self.folder / part.file, tensors)

    def read(self, part: Unit | Shown) -> dict[str, Tensor]:
        """What ``write`` kept."""
        return read_tensors(self.folder / part.file)[0]

    def gather(self, row: int, seed: int, batches: int, name: str) -> Tensor:
        """A tensor of every clip of a measured row at a seed."""
        return torch.cat([self.read(Unit(row, seed, batch))[name] for batch in range(batches)])


def different(one: Any, other: Any, where: str = "") -> str:
    """The first thing that two plans differ in, with both values."""
    if isinstance(one, dict) and isinstance(other, dict):
        key = next(key for key in sorted({*one, *other}) if one.get(key) != other.get(key))
        return different(one.get(key), other.get(key), f"{where} {key}".strip())
    return f"{where}: {one}, now {other}"
