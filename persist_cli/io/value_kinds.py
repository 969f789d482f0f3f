"""What the types of settings allow, in words for messages and listings."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, Final, Literal

NUMBERS: Final = ("no", "one", "two", "three", "four", "five", "six")

# names of bounds in pydantic's and annotated_types' metadata
BOUNDS: Final = {"ge": "of at least {}", "gt": "above {}", "le": "of at most {}", "lt": "below {}"}

SINGULAR: Final = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}
PLURAL: Final = {int: "whole numbers", float: "numbers", str: "texts", bool: "true or false"}

LONGEST: Final = 60  # characters of a wrong value in a message


def describe_kind(kind: Any) -> str:
    """Say what a type allows: ``a whole number of at least 1``, ``three numbers``, ``cross or canvas``.

    Args:
        kind: the annotation of a field, with its bounds in ``Annotated``.
    """
    bare, metadata = _without_bounds(kind)
    alternatives = union_members(bare)
    if alternatives:
        return ", or ".join([*map(describe_kind, alternatives), "null"])
    origin, arguments = typing.get_origin(bare), typing.get_args(bare)
    if origin is Literal:
        return join_words([value if isinstance(value, str) else plain_value(value) for value in arguments], "or")
    if is_fixed_tuple(bare):
        return _fixed_tuple(arguments)
    if origin in (tuple, list, Sequence):
        fewest = next((item.min_length for item in _parts(metadata) if getattr(item, "min_length", None)), 0)
        return f"a list of {NUMBERS[fewest] + ' or more ' if fewest else ''}{_plural(arguments[0])}"
    if origin in (dict, Mapping) or bare in (dict, Mapping) or _has_fields(bare):
        return "a mapping"
    return f"{SINGULAR.get(bare, 'a value')}{_bounds(metadata)}"


def union_members(kind: Any) -> list[Any]:
    """The types in a union, ``None`` left out; empty for other types."""
    if typing.get_origin(kind) not in (typing.Union, types.UnionType):
        return []
    return [member for member in typing.get_args(kind) if member is not type(None)]


def is_fixed_tuple(kind: Any) -> bool:
    """Whether a type is a tuple of so many values, not of any number of them."""
    return typing.get_origin(kind) is tuple and Ellipsis not in typing.get_args(kind)


def kind_at(kind: Any, place: Sequence[str | int]) -> tuple[Any, tuple[str | int, ...]]:
    """The type of a value inside a value, and the part of ``place`` that leads to it.

    Tuples of so many values are taken as one value, and so is everything that the types do not tell.

    Args:
        kind: a dataclass, a pydantic model or the type of a field.
        place: names of fields, keys and positions, as pydantic gives them.
    """
    for depth, part in enumerate(place):
        inside = _kind_inside(_without_bounds(kind)[0], part)
        if inside is None:
            return kind, tuple(place[:depth])
        kind = inside
    return kind, tuple(place)


def plain_value(value: Any) -> str:
    """A value as YAML has it, shortened, for the end of a message."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, Mapping):
        return "a mapping" if value else "an empty mapping"
    text = repr(list(value) if isinstance(value, tuple) else value)
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}…"


def join_words(words: Iterable[str], last: str) -> str:
    """A list in words: ``a, b or c``."""
    *first, end = words
    return f"{', '.join(first)} {last} {end}" if first else end


def _kind_inside(kind: Any, part: str | int) -> Any:
    """The type of the field, key or position ``part`` of a value, ``None`` where the type does not tell it."""
    for member in union_members(kind):
        inside = _kind_inside(_without_bounds(member)[0], part)
        if inside is not None:
            return inside
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (dict, Mapping):
        return arguments[1] if arguments[1] is not Any else None
    if origin in (tuple, list) and not is_fixed_tuple(kind):
        return arguments[0] if isinstance(part, int) else None
    if _has_fields(kind):
        return typing.get_type_hints(kind, include_extras=True).get(str(part))
    return None


def _has_fields(kind: Any) -> bool:
    """Whether a type is a dataclass or a pydantic model."""
    return dataclasses.is_dataclass(kind) or hasattr(kind, "model_fields")


def _without_bounds(kind: Any) -> tuple[Any, tuple[Any, ...]]:
    if typing.get_origin(kind) is not Annotated:
        return kind, ()
    bare, *metadata = typing.get_args(kind)
    inner, more = _without_bounds(bare)
    return inner, (*more, *metadata)


def _fixed_tuple(kinds: Sequence[Any]) -> str:
    count = NUMBERS[len(kinds)] if len(kinds) < len(NUMBERS) else str(len(kinds))
    if len(set(kinds)) == 1:
        return f"{count} {_plural(kinds[0])}"
    return f"a list of {count}: {join_words(map(describe_kind, kinds), 'and')}"


def _plural(kind: Any) -> str:
    bare, metadata = _without_bounds(kind)
    return f"{PLURAL[bare]}{_bounds(metadata)}" if bare in PLURAL else f"values, each {describe_kind(kind)}"


def _bounds(metadata: Iterable[Any]) -> str:
    """The bounds of a number in words, those of pydantic's ``Field`` and of ``annotated_types``."""
    texts = [
        text.format(plain_value(getattr(part, name)))
        for part in _parts(metadata)
        for name, text in BOUNDS.items()
        if getattr(part, name, None) is not None
    ]
    return f" {join_words(texts, 'and')}" if texts else ""


def _parts(metadata: Iterable[Any]) -> list[Any]:
    """The metadata of an annotation, with what pydantic's ``Field`` holds."""
    return [part for item in metadata for part in (*getattr(item, "metadata", ()), item)]
