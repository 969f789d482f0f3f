"""Strict settings: plain values checked against a frozen dataclass, all errors reported at once."""

from __future__ import annotations

import dataclasses
import difflib
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from persist_cli.errors import RecipeError

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
    from pydantic import TypeAdapter, ValidationError

    problems = list(_unknown_keys(kind, values, ""))
    instance: T | None = None
    try:
        instance = TypeAdapter(kind).validate_python(dict(values))
    except ValidationError as error:
        for item in error.errors():
            key = ".".join(str(part) for part in item["loc"]) or "value"
            problems.append(f"{key}: {item['msg']}")
    if problems or instance is None:
        raise RecipeError(f"{where}: " + "; ".join(problems))
    return instance


def _unknown_keys(kind: Any, values: Any, prefix: str) -> typing.Iterator[str]:
    """A message for each key of ``values`` that no field of the dataclass has, nested dataclasses included."""
    if not dataclasses.is_dataclass(kind) or not isinstance(values, Mapping):
        return
    types_of = typing.get_type_hints(kind)
    known = [field.name for field in dataclasses.fields(kind) if field.init]
    for key, value in values.items():
        if key not in known:
            close = difflib.get_close_matches(str(key), known, n=1)
            hint = f"did you mean '{prefix}{close[0]}'?" if close else f"known: {', '.join(known) or 'none'}"
            yield f"unknown key '{prefix}{key}', {hint}"
        else:
            yield from _unknown_keys(_dataclass_in(types_of[key]), value, f"{prefix}{key}.")


def _dataclass_in(kind: Any) -> Any:
    """The type itself, or the dataclass in a union such as ``X | None``."""
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        return next((part for part in typing.get_args(kind) if dataclasses.is_dataclass(part)), None)
    return kind
