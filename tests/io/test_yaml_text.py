"""YAML is plain values, and a short text does not stand for more than a machine can hold."""

from __future__ import annotations

import pytest
import yaml

from persist_cli.io.yaml_text import MOST, read_yaml

BOMB = "\n".join(["a0: &a0 1", *(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 12))])
MERGED = "\n".join(
    ["a0: &a0 {x: 1}", *(f"a{n}: &a{n} {{<<: [{', '.join([f'*a{n - 1}'] * 10)}]}}" for n in range(1, 12))]
)


@pytest.mark.parametrize(
    "text", ["", "a: 1", "[1, x, null, 1.5, {b: [true]}]", "a: &x {b: 1}\nc: *x\nd: {<<: *x, e: 2}"]
)
def test_values_are_those_of_yaml(text):
    assert read_yaml(text) == yaml.safe_load(text)


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        (BOMB, "its aliases stand for more than"),
        (MERGED, "its aliases stand for more than"),
        ("a: &a [1, *a]", "a value of it contains itself"),
        ("[" * 20_000, "it is nested too deeply"),
        ("a: 2024-13-45", "month must be in"),
    ],
)
def test_a_text_that_stands_for_too_much_is_refused_at_once(text, cause):
    with pytest.raises(ValueError, match=cause):
        read_yaml(text)


def test_many_values_without_aliases_are_as_many_as_they_are():
    assert len(read_yaml(f"[{'0, ' * (MOST - 1)}]")) == MOST - 1


def test_no_object_of_python_is_made():
    with pytest.raises(yaml.YAMLError, match="could not determine a constructor"):
        read_yaml("!!python/object/apply:os.system [true]")
