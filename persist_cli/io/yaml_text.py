"""YAML that anybody may have written: a short text must not stand for more than a machine can hold."""

from __future__ import annotations

from typing import Any, Final

import yaml

MOST: Final = 100_000  # values that a text may stand for, those of its aliases counted each time


def read_yaml(text: str) -> Any:
    """The plain values of a YAML text.

    Raises:
        yaml.YAMLError: when it is not YAML, or asks for an object of Python.
        ValueError: when it is nested too deeply, contains itself or stands for too many values, or for a date such as
            2024-13-45.
    """
    loader = yaml.SafeLoader(text)
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
