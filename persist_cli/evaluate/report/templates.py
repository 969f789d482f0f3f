"""What all reports share: their templates, and the facts about where they were made."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from jinja2 import Environment

PACKAGE: Final = "persist_cli.evaluate.report"  # has the style of all pages


def page_templates(package: str = PACKAGE) -> Environment:
    """Return the templates of a package, with the style of reports; all values that are filled in are escaped."""
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

    jinja = Environment(
        loader=ChoiceLoader([PackageLoader(name, ".") for name in dict.fromkeys((package, PACKAGE))]), autoescape=True,
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    jinja.filters["shell"] = shlex.join
    return jinja


def environment_facts(environment: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return name and text of each entry of the environment, packages one by one."""
    facts: list[tuple[str, str]] = []
    for name, value in environment.items():
        entries = value if isinstance(value, Mapping) else {name: value}
        facts += [(str(key), str(entry)) for key, entry in entries.items()]
    return facts
