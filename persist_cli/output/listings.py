"""Listings of what is installed: ``persist plugins`` and ``persist recipes``."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Sequence

from persist_cli.errors import PluginError, RecipeError
from persist_cli.output.console import print_json, print_table, say
from persist_cli.plugins import KINDS, Plugin, first_line, import_plugin, list_misplaced, list_plugins, make_settings
from persist_cli.recipe import make_recipe, read_recipe, recipe_names


def show_plugins(json: bool) -> None:
    """Import every plugin on its own, and print whether each can be used."""
    rows = [row for kind in KINDS for row in plugin_rows(list_plugins(kind))]
    rows += [[entry.kind, entry.name, entry.package, entry.version, cause] for entry, cause in list_misplaced()]
    _show("Plugins", ("kind", "name", "package", "version", "state"), rows, json)


def show_recipes(json: bool) -> None:
    """Print name, stage, memory and description of every recipe of the package."""
    rows = []
    for name in recipe_names():
        recipe = make_recipe(read_recipe(name), name)
        rows.append([name, recipe.stage, recipe.memory.name if recipe.memory else "", recipe.description])
    _show("Recipes", ("name", "stage", "memory", "description"), rows, json)
    if not json:
        say("every setting of one, as YAML to start from: persist recipes NAME > mine.yaml")


def plugin_rows(plugins: list[Plugin]) -> list[list[str]]:
    """Kind, name, package, version and state of plugins of one kind."""
    claims = Counter(plugin.name for plugin in plugins)
    return [
        [plugin.kind, plugin.name, plugin.package, plugin.version, plugin_state(plugin, claims[plugin.name])]
        for plugin in plugins
    ]


def plugin_state(plugin: Plugin, claims: int) -> str:
    """``ok``, or the cause why the plugin cannot be used.

    Args:
        plugin: the plugin, which is imported.
        claims: number of packages that have a plugin of this kind and name.
    """
    if claims > 1:
        return f"name claimed by {claims} packages"
    try:
        loaded = import_plugin(plugin)
        with contextlib.suppress(RecipeError):  # some must be given
            make_settings(plugin.kind, plugin.name, {})
        missing = loaded.missing() if plugin.kind in ("simulator", "cost") else ""
    except PluginError as error:
        return error.cause
    except (Exception, SystemExit) as error:  # a plugin may raise anything, and the others are listed all the same
        return f"its missing() raised {first_line(error)}"
    return missing or "ok"


def _show(title: str, columns: Sequence[str], rows: list[list[str]], json: bool) -> None:
    if json:
        print_json([dict(zip(columns, row, strict=True)) for row in rows])
    else:
        print_table(title, columns, rows)
