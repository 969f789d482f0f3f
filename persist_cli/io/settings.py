"""Strict settings: plain values checked against a frozen dataclass, all errors reported at once."""

from __future__ import annotations

import dataclasses
import math
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, TypeVar

from persist_cli.errors import RecipeError, nearest_name
from persist_cli.io.value_kinds import describe_kind, is_fixed_tuple, kind_at, plain_value, union_members

if TYPE_CHECKING:
    from pydantic import TypeAdapter, ValidationError
    from pydantic_core import ErrorDetails

T = TypeVar("T")


@dataclass(frozen=True)
class NoSettings:
    """The settings of plugins that have none."""


def parse_settings(kind: type[T], values: Mapping[str, Any], where: str) -> T:
    """An instance of the frozen dataclass ``kind`` made from plain values, as YAML gives them.

    Args:
        kind: a dataclass, whose fields may be dataclasses too.
        values: plain values by the names of the fields.
        where: the file or plugin that the values are for, with which error messages begin.

    Raises:
        RecipeError: one line with every unknown key and the known one nearest to it, missing key and wrong value.
    """
    from pydantic import ValidationError

    problems = [*_unknown_keys(kind, values, ""), *_infinite_numbers(values, "")]
    instance: T | None = None
    try:
        instance = _adapter_of(kind).validate_python(dict(values))  # type: ignore[arg-type]  # a class is hashable
    except ValidationError as error:
        problems += plain_problems(kind, values, error)
    if problems or instance is None:
        raise RecipeError(f"{where}: " + "; ".join(problems))
    return instance


@lru_cache
def _adapter_of(kind: type[T]) -> TypeAdapter[T]:
    """Pydantic's view of a type; making it takes milliseconds, checking values with it hardly any."""
    from pydantic import TypeAdapter

    return TypeAdapter(kind)


def plain_problems(kind: Any, values: Mapping[str, Any], error: ValidationError) -> list[str]:
    """Say in plain words what pydantic found wrong, each problem once.

    Args:
        kind: the dataclass or pydantic model that the values were checked against.
        values: the values.
        error: what pydantic found.
    """
    return list(dict.fromkeys(_plain_problem(kind, values, item) for item in error.errors(include_url=False)))


def _plain_problem(kind: Any, values: Mapping[str, Any], item: ErrorDetails) -> str:
    wanted, place = kind_at(kind, item["loc"])
    key = ".".join(str(part) for part in place) or "value"
    if item["type"] == "value_error":  # raised by the settings themselves, in words that are ours
        cause = str(item["ctx"]["error"])
        return f"{key}: {cause}" if place else cause
    if item["type"] == "missing" and place == item["loc"]:
        return f"{key} is missing; it must be {describe_kind(wanted)}"
    value = _value_at(values, place)
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    example = f", as in {[value] * len(typing.get_args(wanted))}" if is_fixed_tuple(wanted) and is_number else ""
    return f"{key} must be {describe_kind(wanted)}{example}, not {plain_value(value)}"


def _value_at(values: Any, place: Sequence[str | int]) -> Any:
    """The value at a place, or the innermost one around it where pydantic's name of the place is no key of ours."""
    for part in place:
        try:
            values = values[part]
        except (KeyError, IndexError, TypeError):
            break
    return values


def _unknown_keys(kind: Any, values: Any, prefix: str) -> typing.Iterator[str]:
    """A message for each key of ``values`` that no field of the dataclass has, nested dataclasses included."""
    if not dataclasses.is_dataclass(kind) or not isinstance(values, Mapping):
        return
    types_of = typing.get_type_hints(kind)
    known = [field.name for field in dataclasses.fields(kind) if field.init]
    for key, value in values.items():
        if key not in known:
            nearest = nearest_name(str(key), known)
            hint = f"did you mean '{prefix}{nearest}'?" if nearest else f"known: {', '.join(known) or 'none'}"
            yield f"unknown key '{prefix}{key}', {hint}"
        else:
            yield from _unknown_keys(_dataclass_in(types_of[key]), value, f"{prefix}{key}.")


def _infinite_numbers(value: Any, key: str) -> typing.Iterator[str]:
    """A message for each number that is infinite or none, which no setting takes."""
    if isinstance(value, float) and not math.isfinite(value):
        yield f"{key} is {value}; give a finite number"
    elif isinstance(value, Mapping):
        for name, part in value.items():
            yield from _infinite_numbers(part, f"{key}.{name}" if key else str(name))
    elif isinstance(value, list | tuple):
        for number, part in enumerate(value):
            yield from _infinite_numbers(part, f"{key}[{number}]")


def _dataclass_in(kind: Any) -> Any:
    """The type itself, or the dataclass in a union such as ``X | None``."""
    return next((part for part in union_members(kind) if dataclasses.is_dataclass(part)), kind)
