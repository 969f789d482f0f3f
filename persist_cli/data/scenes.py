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
        """JSON values: names, and pairs of names for all those from one number to another."""
        return {"complete": self.complete, "names": shortened(self.names)}

    @staticmethod
    def from_json(values: Any) -> TrainingScenes:
        """What ``to_json`` gave.

        Raises:
            ValueError: when it is anything else.
        """
        match values:
            case {"complete": bool(complete), "names": list(names), **others} if not others:
                return TrainingScenes(frozenset(name for each in names for name in _written_out(each)), complete)
        raise ValueError("not a list of scenes")


def shortened(names: Iterable[str]) -> list[str | list[str]]:
    """The names in order; those that count on with as many digits as a pair of the first and the last."""
    runs: list[list[str]] = []
    for name in sorted(set(names), key=_place):
        if runs and _place(name) == _after(runs[-1][-1]):
            runs[-1].append(name)
        else:
            runs.append([name])
    return [run[0] if len(run) == 1 else [run[0], run[-1]] for run in runs]


def _place(name: str) -> tuple[str, int, int]:
    """What a name begins with, how many digits it ends in, and their number; -1 without any."""
    match = NUMBERED.fullmatch(name)
    return (match["prefix"], len(match["number"]), int(match["number"])) if match else (name, 0, -1)


def _after(name: str) -> tuple[str, int, int] | None:
    prefix, digits, number = _place(name)
    return (prefix, digits, number + 1) if digits else None


def _written_out(entry: Any) -> list[str]:
    if isinstance(entry, str):
        return [entry]
    if not (isinstance(entry, list) and len(entry) == 2 and all(isinstance(end, str) for end in entry)):
        raise ValueError(f"neither a scene nor a range of scenes: {entry!r}")
    (prefix, digits, first), last = _place(entry[0]), _place(entry[1])
    if not digits or last[:2] != (prefix, digits):
        raise ValueError(f"no range of scenes: {entry!r}")
    return [f"{prefix}{number:0{digits}d}" for number in range(first, last[2] + 1)]
