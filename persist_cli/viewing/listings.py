"""``persist plugins`` and ``persist recipes``: what is installed."""

from __future__ import annotations

from collections import Counter

from persist_cli.errors import PluginError
from persist_cli.plugins import KINDS, Plugin, import_plugin, list_plugins
from persist_cli.recipe import make_recipe, read_recipe, recipe_names
from persist_cli.viewing.console import print_json, print_table


def show_plugins(json: bool) -> None:
    """Import every plugin on its own and show what came of it."""
    rows = [row for kind in KINDS for row in plugin_rows(list_plugins(kind))]
    if json:
        print_json([dict(zip(("kind", "name", "package", "version", "state"), row, strict=True)) for row in rows])
    else:
        print_table("Plugins", ("kind", "name", "package", "version", "state"), rows)


def plugin_rows(plugins: list[Plugin]) -> list[list[str]]:
    """Kind, name, package, version and state of plugins of one kind."""
    claims = Counter(plugin.name for plugin in plugins)
    return [
        [plugin.kind, plugin.name, plugin.package, plugin.version, plugin_state(plugin, claims[plugin.name])]
        for plugin in plugins
    ]


def plugin_state(plugin: Plugin, claims: int) -> str:
    """``ok``, or the cause why it cannot be used."""
    if claims > 1:
        return f"name claimed by {claims} packages"
    try:
        import_plugin(plugin)
    except PluginError as error:
        return str(error).partition(" is broken: ")[2]
    return "ok"


def show_recipes(json: bool) -> None:
    """Name, stage, memory and description of each."""
    recipes = [(name, make_recipe(read_recipe(name), name)) for name in recipe_names()]
    rows = [[name, each.stage, each.memory.name if each.memory else "", each.description] for name, each in recipes]
    if json:
        print_json([dict(zip(("name", "stage", "memory", "description"), row, strict=True)) for row in rows])
    else:
        print_table("Recipes", ("name", "stage", "memory", "description"), rows)
