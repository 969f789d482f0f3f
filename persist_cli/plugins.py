"""Plugins by entry point: the only door to backbones, memories, encoders, simulators and importers.

Listing imports nothing. Loading imports one plugin, checks its base class and wraps any failure in one line
that names plugin, package, version, target and cause.
"""

from __future__ import annotations

import importlib
from collections import defaultdict
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, Any

from persist_cli.errors import PluginError, hint

if TYPE_CHECKING:
    from persist_cli.api.backbone import Backbone
    from persist_cli.api.encoder import Encoder
    from persist_cli.api.importer import Importer
    from persist_cli.api.memory import FrameOfReference, Memory
    from persist_cli.api.simulator import Simulator


# kind -> (entry point group, module and class of the abstract base)
KINDS = {
    "backbone": ("persist.backbones", "persist_cli.api.backbone:Backbone"),
    "memory": ("persist.memories", "persist_cli.api.memory:Memory"),
    "encoder": ("persist.encoders", "persist_cli.api.encoder:Encoder"),
    "simulator": ("persist.simulators", "persist_cli.api.simulator:Simulator"),
    "importer": ("persist.importers", "persist_cli.api.importer:Importer"),
}


@dataclass(frozen=True)
class Plugin:
    """A plugin before it is imported.

    Args:
        kind: a key of ``KINDS``.
        name: what users call it.
        target: ``module:class``.
        package: the distribution that brings it.
        version: of that distribution.
    """

    kind: str
    name: str
    target: str
    package: str
    version: str

    def __str__(self) -> str:
        return f"{self.kind} {self.name!r} ({self.package} {self.version}, {self.target})"


def list_plugins(kind: str) -> list[Plugin]:
    """Every installed plugin of a kind, sorted by name; imports none of them."""
    group, _ = KINDS[kind]
    plugins = {_describe(kind, entry) for entry in entry_points(group=group)}
    return sorted(plugins, key=lambda plugin: (plugin.name, plugin.package))


def find_plugin(kind: str, name: str) -> Plugin:
    """A plugin by name, not imported yet.

    Raises:
        PluginError: when the name is unknown or claimed by two packages.
    """
    named: dict[str, list[Plugin]] = defaultdict(list)
    for plugin in list_plugins(kind):
        named[plugin.name].append(plugin)
    if name not in named:
        raise PluginError(f"unknown {kind} {name!r}; {hint(name, sorted(named), 'installed')}")
    if len(named[name]) > 1:
        packages = " and ".join(plugin.package for plugin in named[name])
        raise PluginError(f"{kind} {name!r} is claimed by {packages}; uninstall one of them")
    return named[name][0]


def load_plugin(kind: str, name: str) -> type[Any]:
    """The class of a plugin.

    Raises:
        PluginError: when the name is unknown, claimed by two packages, or the plugin is broken.
    """
    return import_plugin(find_plugin(kind, name))


def import_plugin(plugin: Plugin) -> type[Any]:
    """Import a plugin and check that it is of its kind."""
    _, base_target = KINDS[plugin.kind]
    base = _resolve(base_target)
    try:
        loaded = _resolve(plugin.target)
    except Exception as error:  # the plugin border: whatever a foreign module raises
        cause = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else 'no message'}"
        raise PluginError(f"{plugin} is broken: {cause}") from error
    if not (isinstance(loaded, type) and issubclass(loaded, base)):
        raise PluginError(f"{plugin} is broken: it is no subclass of {base_target.replace(':', '.')}")
    loaded.name = plugin.name  # type: ignore[attr-defined]
    return loaded


def make_encoder(name: str, settings: dict[str, Any]) -> Encoder:
    """An encoder by name with plain settings."""
    return _make("encoder", name, settings)  # type: ignore[no-any-return]


def make_memory(name: str, settings: dict[str, Any], encoder: Encoder, reference: FrameOfReference) -> Memory:
    """An empty memory by name with plain settings."""
    return _make("memory", name, settings, encoder, reference)  # type: ignore[no-any-return]


def make_backbone(name: str, settings: dict[str, Any]) -> Backbone:
    """A backbone by name with plain settings, its weights not loaded yet."""
    return _make("backbone", name, settings)  # type: ignore[no-any-return]


def make_simulator(name: str, settings: dict[str, Any]) -> Simulator:
    """A simulator by name with plain settings."""
    return _make("simulator", name, settings)  # type: ignore[no-any-return]


def make_importer(name: str) -> Importer:
    """An importer by name."""
    return load_plugin("importer", name)()  # type: ignore[no-any-return]


def _make(kind: str, name: str, settings: dict[str, Any], *rest: Any) -> Any:
    from persist_cli.io.settings import parse_settings

    plugin = load_plugin(kind, name)
    return plugin(parse_settings(plugin.settings_type, settings, f"{kind} {name!r}"), *rest)


def _describe(kind: str, entry: EntryPoint) -> Plugin:
    package, version = (entry.dist.name, entry.dist.version) if entry.dist else ("unknown package", "?")
    return Plugin(kind, entry.name, entry.value, package, version)


def _resolve(target: str) -> Any:
    module, _, attribute = target.partition(":")
    return getattr(importlib.import_module(module), attribute)
