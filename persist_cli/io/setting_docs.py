"""Settings with their defaults and meanings, which are those of the docstrings."""

from __future__ import annotations

import dataclasses
import functools
import re
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from inspect import cleandoc
from typing import Any, Final

from persist_cli.io.value_kinds import describe_kind, union_members

ARGUMENT: Final = re.compile(r"(?m)^    (\w+): ((?:.|\n(?=     |\n))*)")  # of the part Args of a docstring

UNTOLD: Final = {"text", "a mapping", "a value", "true or false"}  # kinds that a meaning needs no word about


@dataclass(frozen=True)
class Setting:
    """A setting with its default and its meaning.

    Args:
        name: its key.
        meaning: what it means, without a full stop.
        allowed: the values that it may have, in words.
        default: its default as a plain value, ``None`` where it is needed.
        needed: whether it has no default.
        inside: the settings that it holds, where it is a mapping of known keys.
    """

    name: str
    meaning: str
    allowed: str = ""
    default: Any = None
    needed: bool = False
    inside: tuple[Setting, ...] = ()


def settings_of(kind: type, defaults: Mapping[str, Any] | None = None) -> list[Setting]:
    """The settings of a dataclass, in the order of its fields.

    Args:
        kind: the dataclass, whose docstring has a part ``Args``.
        defaults: plain values that stand in for the defaults of the fields.
    """
    return _read_settings(kind, defaults) if defaults else [*_own_settings(kind)]


def meanings_in(kind: type) -> dict[str, str]:
    """What the docstrings of a class and its bases say about its arguments."""
    meanings: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        arguments = cleandoc(vars(base).get("__doc__") or "").partition("\nArgs:\n")[2].partition("\n\n")[0]
        for name, text in ARGUMENT.findall(arguments):
            plain = " ".join(text.split()).replace("``None``", "null").replace("``", "")
            meanings[name] = plain.removesuffix(".")
    return meanings


def plain_setting(value: Any) -> Any:
    """A setting's value as YAML and JSON have it: dataclasses as mappings, tuples as lists."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain_setting(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {key: plain_setting(inner) for key, inner in value.items()}
    return [plain_setting(inner) for inner in value] if isinstance(value, list | tuple) else value


@functools.cache
def _own_settings(kind: type) -> tuple[Setting, ...]:
    return tuple(_read_settings(kind, {}))


def _read_settings(kind: type, defaults: Mapping[str, Any]) -> list[Setting]:
    meanings, kinds = meanings_in(kind), typing.get_type_hints(kind, include_extras=True)
    own = [field for field in dataclasses.fields(kind) if field.init]
    return [_setting(field, kinds[field.name], meanings.get(field.name, ""), defaults) for field in own]


def _setting(field: dataclasses.Field[Any], kind: Any, meaning: str, defaults: Mapping[str, Any]) -> Setting:
    default = field.default
    if field.default_factory is not dataclasses.MISSING:
        default = field.default_factory()
    needed = default is dataclasses.MISSING and field.name not in defaults
    value = defaults.get(field.name, None if needed else default)
    held = next((part for part in (kind, *union_members(kind)) if dataclasses.is_dataclass(part)), None)
    inside = tuple(settings_of(held)) if isinstance(held, type) else ()
    return Setting(field.name, meaning, _allowed(kind, meaning), plain_setting(value), needed, inside)


def _allowed(kind: Any, meaning: str) -> str:
    """What a kind allows, as far as the meaning does not tell it."""
    text = describe_kind(kind)
    choices = re.split(", or |, | or ", text)
    told = text in UNTOLD or text.removesuffix(", or null") in UNTOLD
    if told or all(re.search(rf"\b{re.escape(choice)}\b", meaning) for choice in choices):
        return ""
    return text
