"""What was measured: rows of the table, and whether they reach their targets."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from persist_cli.viewing.console import print_table
from tests.benchmarks.full_scale.measuring import Timing

COLUMNS = (
    "model", "what", "s (least)", "samples/s", "util.", "GB", "beside", "its s (least)", "its GB", "ratio (of least)",
    "target",
)  # fmt: skip


@dataclass(frozen=True)
class Target:
    """What a row shall reach.

    Args:
        text: in words.
        value: measured; ``None`` when it could not be.
        limit: of the value.
        at_most: whether the limit is the greatest value that reaches it, else the least.
    """

    text: str
    value: float | None
    limit: float
    at_most: bool = True

    @property
    def reached(self) -> bool | None:
        """Whether it is; ``None`` when it could not be measured."""
        if self.value is None:
            return None
        return self.value <= self.limit if self.at_most else self.value >= self.limit

    def said(self) -> str:
        """For the table."""
        return f"{self.text}: {({None: 'not measured', True: 'reached', False: 'not reached'})[self.reached]}"


@dataclass(frozen=True)
class Row:
    """One work and what it is compared with.

    Args:
        model: whose.
        what: was done.
        ours: how long it took; ``None`` when it did not fit.
        beside: what it is compared with, empty for nothing.
        other: how long that took.
        samples: of one run.
        flops: model FLOPs of one run by formula, 0 where nobody counts.
        peak: FLOP/s of the device.
        targets: what it shall reach.
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
        """Time over that of the other, the median of the rounds."""
        return self.ours.ratio(self.other) if self.ours and self.other else None

    @property
    def ratio_of_least(self) -> float | None:
        """The fastest run over the other's fastest."""
        return self.ours.least / self.other.least if self.ours and self.other else None

    def with_targets(self, *targets: Target) -> Row:
        """The row with what it shall reach."""
        return dataclasses.replace(self, targets=targets)

    def cells(self) -> tuple[str, ...]:
        """For the table."""
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
            "; ".join(target.said() for target in self.targets),
        )

    def to_json(self) -> dict[str, Any]:
        """All figures, JSON values."""
        figures = {"utilisation": self.utilisation, "ratio": self.ratio, "ratio_of_least": self.ratio_of_least}
        targets = [dataclasses.asdict(target) | {"reached": target.reached} for target in self.targets]
        return dataclasses.asdict(self) | figures | {"targets": targets}


def times(timing: Timing | None) -> str:
    """Median and least seconds."""
    return f"{timing.median:.3g} ({timing.least:.3g})" if timing else "does not fit"


def gigabytes(timing: Timing | None) -> str:
    """Peak memory."""
    return "" if timing is None or timing.peak is None else f"{timing.peak / 1e9:.2f}"


def print_rows(title: str, rows: Sequence[Row]) -> None:
    """The table, without the columns that are empty in every row."""
    cells = [row.cells() for row in rows]
    kept = [number for number in range(len(COLUMNS)) if any(row[number] for row in cells)]
    print_table(title, [COLUMNS[number] for number in kept], [[row[number] for number in kept] for row in cells])
