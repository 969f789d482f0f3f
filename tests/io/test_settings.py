"""Settings are parsed strictly, and all their errors are reported at once."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from persist_cli.errors import RecipeError
from persist_cli.io.settings import parse_settings


@dataclass(frozen=True)
class Inner:
    width: int = 3


@dataclass(frozen=True)
class Outer:
    name: str
    inner: Inner = field(default_factory=Inner)
    cell: tuple[float, float, float] = (1.0, 1.0, 1.0)


def test_plain_values_become_the_dataclass():
    assert parse_settings(Outer, {"name": "a", "inner": {"width": 4}, "cell": [1, 2, 3]}, "x") == Outer(
        "a", Inner(4), (1.0, 2.0, 3.0)
    )


def test_all_errors_are_reported_at_once_with_the_nearest_keys():
    with pytest.raises(RecipeError) as error:
        parse_settings(Outer, {"inner": {"widht": 4}, "cell": [1, 2], "nmae": "a"}, "my.yaml")
    text = str(error.value)
    assert text.startswith("my.yaml: ")
    for part in ("'inner.widht', did you mean 'inner.width'", "'nmae', did you mean 'name'", "cell", "name: "):
        assert part in text
    assert "\n" not in text
