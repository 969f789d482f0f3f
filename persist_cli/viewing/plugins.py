"""``persist plugins``: every plugin with package, version and state."""

from __future__ import annotations

from collections import Counter

from persist_cli.registry import KINDS, Plugin, import_plugin, list_plugins
from persist_cli.viewing.console import print_json, print_table
from persist_cli.world.errors import PluginError


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
