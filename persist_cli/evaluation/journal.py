"""What an evaluation has measured so far: a small file for each batch, so that a stopped one goes on."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from persist_cli.evaluation.cases import Case
from persist_cli.world.errors import PersistError
from persist_cli.world.files import read_json, read_tensors, remove_leftovers, write_json, write_tensors

FOLDER = "parts"


@dataclass(frozen=True)
class Unit:
    """One batch of one row at one seed.

    Args:
        row: its number.
        seed: of the sampling noise.
        batch: its number.
    """

    row: int
    seed: int
    batch: int

    @property
    def file(self) -> str:
        """Where it is kept."""
        return f"row-{self.row:03d}-seed-{self.seed:03d}-batch-{self.batch:05d}.safetensors"


class Journal:
    """The folder of an evaluation's parts.

    Args:
        out: the evaluation's folder.
    """

    def __init__(self, out: Path) -> None:
        self.folder = out / FOLDER

    def check(self, plan: dict[str, Any]) -> None:
        """Raise ``PersistError`` when the folder holds another evaluation than this one."""
        path = self.folder / "plan.json"
        there = read_json(path) if path.is_file() else plan
        if there != plan:
            raise PersistError(
                f"{self.folder.parent}: holds another evaluation ({different(there, plan)}); choose another --out or "
                "delete it"
            )
        remove_leftovers(self.folder)

    def begin(self, plan: dict[str, Any], cases: Sequence[Case]) -> None:
        """Keep what is measured, and on which clips."""
        self.folder.mkdir(parents=True, exist_ok=True)
        write_json(self.folder / "plan.json", plan)
        write_json(self.folder / "cases.json", [dataclasses.asdict(case) for case in cases])

    def cases(self) -> list[Case] | None:
        """The cases, when they were found before."""
        path = self.folder / "cases.json"
        return [Case.from_json(each) for each in read_json(path)] if path.is_file() else None

    def has(self, unit: Unit) -> bool:
        """Whether a batch was measured."""
        return (self.folder / unit.file).is_file()

    def write(self, unit: Unit, tensors: dict[str, Tensor]) -> None:
        """Keep a batch's figures ``[clip, frame, metric]`` and features, whole or not at all."""
        write_tensors(self.folder / unit.file, tensors)

    def read(self, unit: Unit) -> dict[str, Tensor]:
        """What ``write`` kept."""
        return read_tensors(self.folder / unit.file)[0]

    def gather(self, row: int, seed: int, batches: int, name: str) -> Tensor:
        """A tensor of every clip of a measured row at a seed."""
        return torch.cat([self.read(Unit(row, seed, batch))[name] for batch in range(batches)])


def different(one: Any, other: Any, where: str = "") -> str:
    """The first thing that two plans differ in, with both values."""
    if isinstance(one, dict) and isinstance(other, dict):
        key = next(key for key in sorted({*one, *other}) if one.get(key) != other.get(key))
        return different(one.get(key), other.get(key), f"{where} {key}".strip())
    return f"{where}: {one}, now {other}"
