"""The code of plugins of other packages: after a change, what one measured or computed before is not its own."""

from __future__ import annotations

import importlib.util
from importlib.machinery import EXTENSION_SUFFIXES, SOURCE_SUFFIXES
from pathlib import Path
from typing import Final

from persist_cli.errors import PluginError
from persist_cli.io.files import files_sha256
from persist_cli.plugins import OWN, find_plugin

SHOWN: Final = 12  # digits of a hash

MODULES: Final = (*SOURCE_SUFFIXES, *EXTENSION_SUFFIXES)


def code_of(kind: str, name: str) -> str | None:
    """Package, version and a hash of the code of a plugin; ``None`` for one of persist's own.

    All modules count of the outermost package that is no namespace, since the plugin may import any of them. A plugin
    that is edited in place keeps its version, and is another one by its hash.

    Args:
        kind: a key of ``persist_cli.plugins.KINDS``.
        name: the name that users choose it by; it need not be installed.
    """
    try:
        plugin = find_plugin(kind, name)
    except PluginError:
        return "not installed"
    if plugin.module in OWN:
        return None
    code = files_sha256(*_sources(plugin.target.partition(":")[0]))
    return f"{plugin.package} {plugin.version}, code {code[:SHOWN]}"


def code_json(*plugins: tuple[str, str]) -> dict[str, dict[str, str]]:
    """What ``code_of`` says of plugins, under the key ``code``, for JSON values of what was made with them.

    Args:
        plugins: kind and name of each. Those of persist's own are left out, and without another there is no key.
    """
    found = {f"{kind} {name}": code_of(kind, name) for kind, name in plugins}
    others = {plugin: code for plugin, code in found.items() if code is not None}
    return {"code": others} if others else {}


def _sources(module: str) -> tuple[Path, list[Path]]:
    """The folder of a module's outermost package, and its files; or the module's own file. Nothing is imported."""
    names = module.split(".")
    for end in range(1, len(names) + 1):
        spec = importlib.util.find_spec(".".join(names[:end]))
        if spec is None:  # loading the plugin says so
            break
        if not spec.has_location or spec.origin is None:  # a namespace, which other packages share
            continue
        file = Path(spec.origin)
        if spec.submodule_search_locations is None:
            return file.parent, [file]
        modules = (path for path in file.parent.rglob("*.*") if path.name.endswith(MODULES))
        return file.parent, [path for path in modules if path.is_file()]  # editors lock files by links to nothing
    return Path(), []
