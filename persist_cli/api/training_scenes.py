"""The scenes that a model was trained on, by name, as cards keep them."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Final

NUMBERED: Final = re.compile(r"(?P<prefix>.*?)(?P<number>[0-9]+)", re.DOTALL)


@dataclass(frozen=True)
class TrainingScenes:
    """Names of the scenes that a model was trained on, and the views of its cameras.

    Args:
        names: values of ``TrajectoryInfo.scene``, or names of parts of scenes.
        complete: whether the model is known to have seen no other scene.
        fov: least and greatest degrees of view from the top of the images to their bottom; ``None`` if unknown.
    """

    names: frozenset[str] = frozenset()
    complete: bool = True
    fov: tuple[float, float] | None = field(default=None, compare=False)

    def __or__(self, other: TrainingScenes) -> TrainingScenes:
        ends = [*(self.fov or ()), *(other.fov or ())]
        fov = (min(ends), max(ends)) if ends else None
        return TrainingScenes(self.names | other.names, self.complete and other.complete, fov)

    def to_json(self) -> dict[str, Any]:
        """Return JSON values, with the names as ``name_ranges`` returns them."""
        values = {"complete": self.complete, "names": name_ranges(self.names)}
        return values if self.fov is None else values | {"fov": list(self.fov)}

    @staticmethod
    def from_json(values: Any) -> TrainingScenes:
        """Return the scenes that ``to_json`` wrote.

        Raises:
            ValueError: when the values are anything else.
        """
        match values:
            case {"complete": bool(complete), "names": list(entries), **rest} if set(rest) <= {"fov"}:
                names = frozenset(name for entry in entries for name in _expand(entry))
                return TrainingScenes(names, complete, _fov(rest["fov"]) if rest else None)
        raise ValueError("not a list of scenes")


def name_ranges(names: Iterable[str]) -> list[str | list[str]]:
    """Return names in order, with consecutive numbers as first and last: a1, a2, a3, b becomes ["a1", "a3"], "b".

    Only numbers of equally many digits make a range: 8, 9, 10 becomes ["8", "9"], "10".
    """
    runs: list[list[str]] = []
    for name in sorted(set(names), key=_split_number):
        if runs and _split_number(name) == _successor(runs[-1][-1]):
            runs[-1].append(name)
        else:
            runs.append([name])
    return [run[0] if len(run) == 1 else [run[0], run[-1]] for run in runs]


def _fov(ends: Any) -> tuple[float, float]:
    match ends:
        case [float() | int() as low, float() | int() as high] if 0 < low <= high < 180:
            return float(low), float(high)
    raise ValueError(f"no two angles of view: {ends!r}")


def _split_number(name: str) -> tuple[str, int, int]:
    """Return the text before a name's final digits, their count and their value; the value is -1 without digits."""
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
