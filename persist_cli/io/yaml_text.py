"""YAML that anybody may have written: a short text must not stand for more than a machine can hold."""

from __future__ import annotations

from collections import Counter
from typing import Any, Final

import yaml

from persist_cli.errors import RecipeError

MOST: Final = 100_000  # values that a text may stand for, those of its aliases counted each time


class UniqueKeys(yaml.SafeLoader):
    """Reads YAML as ``safe_load`` does, but refuses a key that a mapping has twice; that would drop the first value."""

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        """The mapping, after a check of its keys."""
        node: yaml.MappingNode = super().compose_mapping_node(anchor)
        names = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        twice = next((name for name, count in Counter(names).items() if count > 1), None)
        if twice is not None:
            raise yaml.MarkedYAMLError(problem=f"the key {twice!r} stands twice", problem_mark=node.start_mark)
        return node


def read_yaml(text: str) -> Any:
    """The plain values of a YAML text.

    Raises:
        yaml.YAMLError: when it is not YAML, has a key twice, or asks for an object of Python.
        ValueError: when it is nested too deeply, contains itself or stands for too many values, or for a date such as
            2024-13-45.
    """
    loader = UniqueKeys(text)
    try:
        root = loader.get_single_node()
        if root is None:
            return None
        if _values_in(root, {}) > MOST:
            raise ValueError(f"its aliases stand for more than {MOST:,} values")
        return loader.construct_document(root)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    finally:
        loader.dispose()


def _values_in(node: yaml.Node, counted: dict[yaml.Node, int]) -> int:
    """How many values a node stands for; ``counted`` holds those of nodes before, 0 of those that it is within."""
    if node not in counted:
        counted[node] = 0
        parts = node.value if isinstance(node, yaml.CollectionNode) else ()
        parts = [part for pair in parts for part in pair] if isinstance(node, yaml.MappingNode) else parts
        counted[node] = 1 + sum(_values_in(part, counted) for part in parts)
    if not counted[node]:
        raise ValueError("a value of it contains itself")
    return counted[node]


def parse_yaml_mapping(text: str, where: str) -> dict[str, Any]:
    """The values of a YAML mapping.

    Args:
        text: YAML.
        where: the recipe's name or file, with which error messages begin.

    Raises:
        RecipeError: one line that says where the text stops being YAML or has a key twice, or that it is no mapping.
    """
    try:
        values = read_yaml(text)
    except (yaml.YAMLError, ValueError) as error:  # the latter for a date such as 2024-13-45
        raise RecipeError(f"{where}: not YAML ({' '.join(str(error).split())})") from error
    if not isinstance(values, dict):
        raise RecipeError(f"{where}: a recipe is a mapping of settings, not {type(values).__name__}")
    return values
