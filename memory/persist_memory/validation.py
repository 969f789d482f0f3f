"""Checks of what memories are given: observations, the tensors of a memory file, memories to merge."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from enum import IntEnum
from typing import Any

import torch
from torch import Tensor

from persist_cli.api.memory import Memory
from persist_cli.api.observations import Observations, Origin, origins_like
from persist_cli.errors import CheckpointError

Shape = tuple[int | None, ...]  # None first: as many rows as the first tensor has; None later: any size

ORIGINS = "origins"  # the tensor with the origin of each stored item

NAMED = 5  # names that a message lists at most


def with_finite_depth(observations: Observations) -> Observations:
    """Return frames in which depth that is not finite, as a simulator may give of the sky, is missing (0)."""
    finite = observations.depth.isfinite()
    return observations if bool(finite.all()) else replace(observations, depth=observations.depth.where(finite, 0.0))


def check_tensors(tensors: Mapping[str, Tensor], expected: Mapping[str, tuple[torch.dtype, Shape]], where: str) -> None:
    """Check that a memory file holds finite tensors of the expected names, types and shapes, all of one length.

    Raises:
        CheckpointError: one line naming the tensor that is missing, unknown, not finite, or of another type or shape.
    """
    if mismatched := sorted(set(tensors) ^ set(expected)):
        raise CheckpointError(f"{where}: its tensors are not those of this memory, see {', '.join(mismatched)}")
    count = len(next(iter(tensors.values()))) if tensors else 0
    for name, (dtype, shape) in expected.items():
        _check_tensor(name, tensors[name], dtype, (count, *shape[1:]), where)


def part_of(
    tensors: Mapping[str, Tensor], expected: Mapping[str, tuple[torch.dtype, Shape]], where: str
) -> list[Tensor]:
    """Return the tensors of a part of a memory that it need not have, in the order of ``expected``; none without it.

    Raises:
        CheckpointError: one line naming a tensor that is missing, or of another type or shape, or not finite.
    """
    names = [name for name in expected if name in tensors]
    if names and len(names) < len(expected):
        raise CheckpointError(f"{where}: tensor {min(set(expected) - set(names))!r} is missing")
    for name in names:
        _check_tensor(name, tensors[name], *expected[name], where)
    return [tensors[name] for name in names]


def _check_tensor(name: str, tensor: Tensor, dtype: torch.dtype, shape: Shape, where: str) -> None:
    fits = tensor.ndim == len(shape) and all(a in (None, b) for a, b in zip(shape, tensor.shape, strict=True))
    if tensor.dtype != dtype or not fits:
        actual = f"{tensor.dtype} {list(tensor.shape)}"
        raise CheckpointError(f"{where}: tensor {name!r} is {actual}, expected {dtype} {list(shape)}")
    if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
        raise CheckpointError(f"{where}: tensor {name!r} has numbers that are not finite")


def with_origins(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return a memory's tensors with the origin of each item; in files of version 1, without it, all are observed."""
    if not tensors or ORIGINS in tensors:
        return tensors
    return tensors | {ORIGINS: origins_like(next(iter(tensors.values())), Origin.OBSERVED)}


def check_origins(tensors: Mapping[str, Tensor], where: str, known: type[IntEnum] = Origin) -> None:
    """Raise ``CheckpointError`` when a memory's tensors have an origin that this version does not know."""
    unknown = set(tensors[ORIGINS].unique().tolist()) - {int(origin) for origin in known}
    if unknown:
        raise CheckpointError(f"{where}: unknown origin {min(unknown)} of an item; a newer persist may know it")


def check_classes(classes: Tensor, count: int, where: str, what: str = "a cell") -> None:
    """Raise ``CheckpointError`` when one of some cells is of a class that a palette of so many does not have."""
    if len(classes) and int(classes.max()) >= count:
        raise CheckpointError(f"{where}: {what} is of class {int(classes.max())}, but its palette has {count} classes")


def check_mergeable(memory: Memory, other: Memory) -> None:
    """Raise ``CheckpointError`` naming the first difference that keeps two memories apart.

    Settings that are ``changeable`` may differ.
    """
    pairs: dict[str, tuple[Any, Any]] = {
        "memory": (memory.name, other.name),
        "frame of reference": (memory.reference.name, other.reference.name),
        "up axis": (memory.reference.world_up, other.reference.world_up),
        "encoder": (memory.encoder.name, other.encoder.name),
    }
    mine, theirs = _settings_of(memory), _settings_of(other)
    pairs |= {name: (value, theirs.get(name)) for name, value in mine.items()}
    for what, (first, second) in pairs.items():
        if first != second:
            raise CheckpointError(f"memories differ in {what} and cannot be merged: {_contrast(first, second)}")


def _settings_of(memory: Memory) -> dict[str, Any]:
    """The settings of a memory and its encoder by name, as in ``memory.size``, without those that are changeable."""
    own = {f"memory.{name}": value for name, value in _values(memory.settings).items() if name not in memory.changeable}
    return own | {f"encoder.{name}": value for name, value in _values(memory.encoder.settings).items()}


def _values(settings: Any) -> dict[str, Any]:
    return {field.name: getattr(settings, field.name) for field in fields(settings)}


def _contrast(first: Any, second: Any) -> str:
    """Two values that differ, in words; of lists of names, such as palettes, the names that only one has."""
    if isinstance(first, tuple) and all(isinstance(name, str) for name in (*first, *second)):
        alone = sorted({*first} ^ {*second})
        if alone:
            return f"only one has {', '.join(alone[:NAMED])}{', …' if len(alone) > NAMED else ''}"
    return f"{first} and {second}"
