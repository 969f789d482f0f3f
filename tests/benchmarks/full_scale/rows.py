"""Rows of the table, and whether they reach their targets."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from persist_cli.output.console import print_table
from tests.benchmarks.full_scale.measuring import Timing

COLUMNS = (
    "model", "what", "s (least)", "samples/s", "util.", "GB", "beside", "its s (least)", "its GB", "ratio (of least)",
    "target",
)  # fmt: skip


@dataclass(frozen=True)
class Target:
    """A target of a row.

    Args:
        text: the target in words.
        value: the measured value; ``None`` when it could not be measured.
        limit: the value that must not be passed.
        at_most: whether the value must be at most the limit, else at least.
    """

    text: str
    value: float | None
    limit: float
    at_most: bool = True

    @property
    def reached(self) -> bool | None:
        """Whether the value reaches the target; ``None`` when it could not be measured."""
        if self.value is None:
            return None
        return self.value <= self.limit if self.at_most else self.value >= self.limit

    def cell(self) -> str:
        """The text of the table's cell."""
        outcomes = {None: "not measured", True: "reached", False: "not reached"}
        return f"{self.text}: {outcomes[self.reached]}"


@dataclass(frozen=True)
class Row:
    """One measurement and what it is compared with.

    Args:
        model: name of the model.
        what: what was measured, in words.
        ours: its timing; ``None`` when it did not fit into memory.
        beside: what it is compared with; empty for nothing.
        other: timing of what it is compared with.
        samples: samples of one run.
        flops: model FLOPs of one run by formula; 0 where none are counted.
        peak: FLOP/s of the device.
        targets: the targets of the row.
    """

    model: str
    what: str
    ours: Timing | None
    beside: str = ""
    other: Timing | None = None
    samples: int = 1
    flops: int = 0
    peak: float = 0.0
    targets: tuple[Target, ...] = ()

    @property
    def utilisation(self) -> float | None:
        """Model FLOPs a second over what the device can do."""
        return self.flops / self.ours.median / self.peak if self.ours and self.flops else None

    @property
    def ratio(self) -> float | None:
        """The median, over the rounds, of our time over the other's."""
        return self.ours.ratio(self.other) if self.ours and self.other else None

    @property
    def ratio_of_least(self) -> float | None:
        """The time of our fastest run over that of the other's fastest."""
        return self.ours.least / self.other.least if self.ours and self.other else None

    def with_targets(self, *targets: Target) -> Row:
        """The row with these targets."""
        return dataclasses.replace(self, targets=targets)

    def cells(self) -> tuple[str, ...]:
        """The cells of the row in the order of ``COLUMNS``."""
        ours, other = self.ours, self.other
        ratios = self.ratio is not None and f"{self.ratio:.2f} ({self.ratio_of_least:.2f})"
        return (
            self.model,
            self.what,
            times(ours),
            f"{self.samples / ours.median:.3g}" if ours else "",
            "" if self.utilisation is None else f"{self.utilisation:.1%}",
            gigabytes(ours),
            self.beside,
            times(other) if self.beside else "",
            gigabytes(other),
            ratios or "",
            "; ".join(target.cell() for target in self.targets),
        )

    def to_json(self) -> dict[str, Any]:
        """All figures as JSON values."""
        figures = {"utilisation": self.utilisation, "ratio": self.ratio, "ratio_of_least": self.ratio_of_least}
        targets = [dataclasses.asdict(target) | {"reached": target.reached} for target in self.targets]
        return dataclasses.asdict(self) | figures | {"targets": targets}


def times(timing: Timing | None) -> str:
    """The text of a timing: median and least seconds."""
    return f"{timing.median:.3g} ({timing.least:.3g})" if timing else "does not fit"


def gigabytes(timing: Timing | None) -> str:
    """The text of a timing's peak memory, in GB."""
    return "" if timing is None or timing.peak is None else f"{timing.peak / 1e9:.2f}"


def print_rows(title: str, rows: Sequence[Row]) -> None:
    """Print the table without the columns that are empty in every row."""
    columns = list(zip(COLUMNS, *(row.cells() for row in rows), strict=True))
    header, *cells = zip(*(column for column in columns if any(column[1:])), strict=True)
    print_table(title, header, cells)
