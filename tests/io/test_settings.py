"""Settings are parsed strictly, and all their errors are reported at once."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import pytest
from pydantic import Field, PositiveFloat, PositiveInt

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


@pytest.mark.parametrize("number", [float("inf"), float("-inf"), float("nan")])
def test_no_setting_takes_a_number_that_is_not_finite(number):
    with pytest.raises(RecipeError, match=rf"^x: cell\[1\] is {number}; give a finite number$"):
        parse_settings(Outer, {"name": "a", "cell": [1.0, number, 2.0]}, "x")


def test_all_errors_are_reported_at_once_with_the_nearest_keys():
    with pytest.raises(RecipeError) as error:
        parse_settings(Outer, {"inner": {"widht": 4}, "cell": [1, 2], "nmae": "a"}, "my.yaml")
    text = str(error.value)
    assert text.startswith("my.yaml: ")
    for part in (
        "'inner.widht', did you mean 'inner.width'",
        "'nmae', did you mean 'name'",
        "cell",
        "name is missing; it must be text",
    ):
        assert part in text
    assert "\n" not in text


@dataclass(frozen=True)
class Kinds:
    steps: PositiveInt = 1
    share: Annotated[float, Field(ge=0, lt=1)] = 0.5
    cell: tuple[PositiveFloat, PositiveFloat, PositiveFloat] = (1.0, 1.0, 1.0)
    window: tuple[int, PositiveInt] | None = None
    strides: tuple[int, ...] = (1,)
    targets: Annotated[tuple[str, ...], Field(min_length=1)] = ("a",)
    form: Literal["cross", "canvas"] = "cross"
    compile: bool = False
    base: str | None = None
    sizes: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.steps == 13:
            raise ValueError("13 steps bring bad luck")


@pytest.mark.parametrize(
    ("values", "message"),
    [({"steps": "soon"}, "steps must be a whole number above 0, not 'soon'"),
     ({"steps": 13}, "13 steps bring bad luck"),
     ({"share": 1}, "share must be a number of at least 0 and below 1, not 1"),
     ({"cell": 0.1}, "cell must be three numbers above 0, as in [0.1, 0.1, 0.1], not 0.1"),
     ({"cell": [0.1, 2]}, "cell must be three numbers above 0, not [0.1, 2]"),
     ({"cell": [0.1, 2, -1]}, "cell must be three numbers above 0, not [0.1, 2, -1]"),
     ({"window": [1, 0]},
      "window must be a list of two: a whole number and a whole number above 0, or null, not [1, 0]"),
     ({"strides": 2}, "strides must be a list of whole numbers, not 2"),
     ({"strides": [1, "a", "b"]}, "strides.1 must be a whole number, not 'a'; strides.2 must be a whole number, "
                                  "not 'b'"),
     ({"targets": []}, "targets must be a list of one or more texts, not []"),
     ({"form": "corss"}, "form must be cross or canvas, not 'corss'"),
     ({"compile": "perhaps"}, "compile must be true or false, not 'perhaps'"),
     ({"base": {"a": 1}}, "base must be text, or null, not a mapping"),
     ({"steps": None}, "steps must be a whole number above 0, not null"),
     ({"sizes": [1]}, "sizes must be a mapping, not [1]")],
)  # fmt: skip
def test_a_wrong_value_is_named_with_what_the_setting_allows(values, message):
    with pytest.raises(RecipeError) as error:
        parse_settings(Kinds, values, "my.yaml")
    assert str(error.value) == f"my.yaml: {message}"
