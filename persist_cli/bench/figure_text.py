"""Figures of a benchmark as text: columns, intervals, paired differences, and Markdown tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal

MISSING: Final = "n/a"


@dataclass(frozen=True)
class FigureColumn:
    """A figure of the tables.

    Args:
        title: in the head of its column.
        better: ``higher``, ``lower``, or ``None`` where neither is.
        percent: whether it is a share, shown in per cent.
        definition: what it says, as a sentence without a full stop.
        digits: of a share behind the point.
    """

    title: str
    better: Literal["higher", "lower"] | None
    percent: bool
    definition: str
    digits: int = field(default=0, kw_only=True)

    @property
    def heading(self) -> str:
        """The head of the column, with an arrow to what is better."""
        arrow = {"higher": " ↑", "lower": " ↓", None: ""}[self.better]
        return f"{self.title}{arrow}"

    def amount(self, value: float, sign: bool = False) -> str:
        """Return a number as the column shows it."""
        if self.percent:
            return f"{100 * value:{'+' * sign}.{self.digits}f} %"
        return f"{value:{'+' * sign}.2f}" if abs(value) < 10 else f"{value:{'+' * sign}.1f}"

    def cell(self, figure: Mapping[str, Any] | None, interval: bool = True) -> str:
        """Return the text of a figure, with its interval where it has one."""
        if figure is None or figure["mean"] is None:
            return MISSING
        text = self.amount(figure["mean"])
        return f"{text} {self.interval(figure)}".rstrip() if interval else text

    def interval(self, figure: Mapping[str, Any]) -> str:
        """Return the text of a figure's interval; empty where it has none.

        Where all houses have the same figure, as 100 %, every bootstrap sample has it too. Such an interval has no
        width, but not because other houses would have no other figure: it is no interval.
        """
        low, high = figure["low"], figure["high"]
        return "" if low is None or low == high else f"[{self.amount(low)}, {self.amount(high)}]"

    def parts(self, figure: Mapping[str, Any] | None) -> dict[str, str]:
        """Return the text of a figure and of its interval apart, the latter empty where it has none."""
        return {"text": self.cell(figure, interval=False), "interval": self.interval(figure) if figure else ""}

    def gap(self, difference: Mapping[str, Any] | None) -> str:
        """Return the text of a paired difference, starred where its interval leaves zero out."""
        if difference is None or difference["mean"] is None:
            return MISSING
        text = self.amount(difference["mean"], sign=True)
        if difference["low"] is None:
            return text
        star = "*" * (difference["low"] > 0 or difference["high"] < 0)
        return f"{text}{star} [{self.amount(difference['low'], True)}, {self.amount(difference['high'], True)}]"


def markdown_table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
