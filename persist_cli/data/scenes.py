"""Scenes that a model was trained on, in a form that stays small where scenes are numbered."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

NUMBERED = re.compile(r"(?P<prefix>.*?)(?P<number>[0-9]+)", re.DOTALL)


@dataclass(frozen=True)
class TrainingScenes:
    """Names of the scenes that a model was trained on.

    Args:
        names: as trajectories give them.
        complete: whether these are known to be all.
    """

    names: frozenset[str] = frozenset()
    complete: bool = True

    def __or__(self, other: TrainingScenes) -> TrainingScenes:
        return TrainingScenes(self.names | other.names, self.complete and other.complete)

    def to_json(self) -> dict[str, Any]:
        """JSON values, with the names as ``name_ranges`` writes them."""
        return {"complete": self.complete, "names": name_ranges(self.names)}

    @staticmethod
    def from_json(values: Any) -> TrainingScenes:
        """The scenes that ``to_json`` wrote.

        Raises:
            ValueError: when the values are anything else.
        """
        match values:
            case {"complete": bool(complete), "names": list(entries), **rest} if not rest:
                return TrainingScenes(frozenset(name for entry in entries for name in _expand(entry)), complete)
        raise ValueError("not a list of scenes")


def name_ranges(names: Iterable[str]) -> list[str | list[str]]:
    """The names in order, consecutive numbers as first and last: a1, a2, a3, b becomes ["a1", "a3"], "b".

    Only numbers of equally many digits make a range: 8, 9, 10 becomes ["8", "9"], "10".
    """
    runs: list[list[str]] = []
    for name in sorted(set(names), key=_split_number):
        if runs and _split_number(name) == _successor(runs[-1][-1]):
            runs[-1].append(name)
        else:
            runs.append([name])
    return [run[0] if len(run) == 1 else [run[0], run[-1]] for run in runs]


def _split_number(name: str) -> tuple[str, int, int]:
    """The text before the final digits of a name, how many digits there are, and their number; -1 without any."""
    match = NUMBERED.fullmatch(name)
    return (match["prefix"], len(match["number"]), int(match["number"])) if match else (name, 0, -1)


def _successor(name: str) -> tuple[str, int, int] | None:
    prefix, digits, number = _split_number(name)
    return (prefix, digits, number + 1) if digits else None


def _expand(entry: Any) -> list[str]:
    if isinstance(entry, str):
        return [entry]
    if not (isinstance(entry, list) and len(entry) == 2 and all(isinstance(end, str) for end in entry)):
        raise ValueError(f"neither a scene nor a range of scenes: {entry!r}")
    (prefix, digits, first), last = _split_number(entry[0]), _split_number(entry[1])
    if not digits or last[:2] != (prefix, digits):
        raise ValueError(f"no range of scenes: {entry!r}")
    return [f"{prefix}{number:0{digits}d}" for number in range(first, last[2] + 1)]
