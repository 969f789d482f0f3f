"""Figures as text: as many digits as a column needs, spreads, intervals and differences."""

from __future__ import annotations

from collections.abc import Iterable

from persist_cli.reporting.results import Cell, Column, Difference

ARROWS = {"higher": "↑", "lower": "↓"}
UNDEFINED = "–"  # a figure that was measured and has no value
MARK = "*"  # behind a difference whose interval leaves zero out

MORE_DIGITS = 3  # for a clear difference that would read as zero


def digits_of(values: Iterable[float | None]) -> int:
    """Decimals that show about four figures of a usual value of a column; an outlier changes nothing."""
    sizes = sorted(abs(value) for value in values if value)
    usual = sizes[(len(sizes) - 1) // 2] if sizes else 0.0
    for digits, least in enumerate((100.0, 10.0, 0.1, 0.01), start=1):
        if usual >= least:
            return digits
    return 5 if usual else 2


def number(value: float | None, digits: int, signed: bool = False) -> str:
    """A number with a true minus sign; a value that rounds to zero has no sign."""
    if value is None:
        return UNDEFINED
    if not round(value, digits):
        value = 0.0
    return f"{value:{'+' if signed and value else ''}.{digits}f}".replace("-", "−")


def spread_text(cell: Cell, digits: int) -> str:
    """``mean ± std``; the mean alone where there is one seed or nothing random."""
    mean = number(cell.mean, digits)
    return mean if cell.std is None or cell.mean is None else f"{mean} ± {number(cell.std, digits)}"


def interval_text(low: float | None, high: float | None, digits: int, signed: bool = False) -> str:
    """``[low, high]``; empty when there is none."""
    if low is None or high is None:
        return ""
    return f"[{number(low, digits, signed)}, {number(high, digits, signed)}]"


def difference_texts(difference: Difference, digits: int) -> tuple[str, str]:
    """The signed difference, marked when its interval leaves zero out, and that interval.

    A clear difference too small for the column's digits gets up to three more; below that it is zero, unmarked.
    """
    mean = difference.mean
    if mean is not None and difference.clear:
        digits = next((more for more in range(digits, digits + MORE_DIGITS + 1) if round(mean, more)), digits)
    mark = MARK if difference.clear and mean is not None and round(mean, digits) else ""
    return number(mean, digits, signed=True) + mark, interval_text(difference.low, difference.high, digits, signed=True)


def heading(column: Column) -> str:
    """The column's title with the arrow of what is better."""
    return f"{column.title} {ARROWS.get(column.better or '', '')}".strip()


def verdict(difference: Difference, better: str | None) -> str:
    """``better`` or ``worse`` when the difference is clear, else ``open``."""
    if not difference.clear or better not in ARROWS or difference.mean is None:
        return "open"
    return "better" if (difference.mean > 0) == (better == "higher") else "worse"
