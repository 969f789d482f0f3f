"""Plugins by entry point: backbones, memories, encoders, simulators and importers, those of persist itself too.

Listing plugins imports none. Loading imports one and checks its base class; any failure becomes one line that names
plugin, package, version, target and cause.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, Any, Final

from persist_cli.errors import PluginError, hint

if TYPE_CHECKING:
    from persist_cli.api.backbone import Backbone
    from persist_cli.api.encoder import Encoder
    from persist_cli.api.importer import Importer
    from persist_cli.api.memory import FrameOfReference, Memory
    from persist_cli.api.simulator import Simulator

# for each kind of plugin, the group of its entry points and the abstract base class
KINDS: Final = {
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
        name: the name that users choose it by.
        target: its class, as ``module:class``.
        package: the distribution that it comes with.
        version: the version of that distribution.
    """

    kind: str
    name: str
    target: str
    package: str
    version: str

    def __str__(self) -> str:
        return f"{self.kind} {self.name!r} ({self.package} {self.version}, {self.target})"


def list_plugins(kind: str) -> list[Plugin]:
    """All installed plugins of a kind, sorted by name; none is imported."""
    group, _ = KINDS[kind]
    plugins = {_describe(kind, entry) for entry in entry_points(group=group)}
    return sorted(plugins, key=lambda plugin: (plugin.name, plugin.package))


def find_plugin(kind: str, name: str) -> Plugin:
    """The plugin of a name, which is not imported yet.

    Raises:
        PluginError: when the name is unknown or claimed by two packages.
    """
    installed = list_plugins(kind)
    plugins = [plugin for plugin in installed if plugin.name == name]
    if not plugins:
        names = sorted({plugin.name for plugin in installed})
        raise PluginError(f"unknown {kind} {name!r}; {hint(name, names, 'installed')}")
    if len(plugins) > 1:
        packages = " and ".join(plugin.package for plugin in plugins)
        raise PluginError(f"{kind} {name!r} is claimed by {packages}; uninstall one of them")
    return plugins[0]


def load_plugin(kind: str, name: str) -> type[Any]:
    """The class of a plugin.

    Raises:
        PluginError: when the name is unknown, claimed by two packages, or the plugin is broken.
    """
    return import_plugin(find_plugin(kind, name))


def import_plugin(plugin: Plugin) -> type[Any]:
    """Import the class of a plugin.

    Raises:
        PluginError: when that fails, or the class is not of the plugin's kind.
    """
    _, base_target = KINDS[plugin.kind]
    base = _resolve(base_target)
    try:
        loaded = _resolve(plugin.target)
    except Exception as error:  # the module of another package may raise anything
        cause = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else 'no message'}"
        raise PluginError(f"{plugin} is broken: {cause}") from error
    if not (isinstance(loaded, type) and issubclass(loaded, base)):
        raise PluginError(f"{plugin} is broken: it is no subclass of {base_target.replace(':', '.')}")
    loaded.name = plugin.name  # type: ignore[attr-defined]
    return loaded


def make_encoder(name: str, settings: dict[str, Any]) -> Encoder:
    """Make the encoder of a name with plain settings."""
    return _make("encoder", name, settings)  # type: ignore[no-any-return]


def make_memory(name: str, settings: dict[str, Any], encoder: Encoder, reference: FrameOfReference) -> Memory:
    """Make an empty memory of a name with plain settings."""
    return _make("memory", name, settings, encoder, reference)  # type: ignore[no-any-return]


def make_backbone(name: str, settings: dict[str, Any]) -> Backbone:
    """Make the backbone of a name with plain settings; no checkpoint is loaded into it."""
    return _make("backbone", name, settings)  # type: ignore[no-any-return]


def make_simulator(name: str, settings: dict[str, Any]) -> Simulator:
    """Make the simulator of a name with plain settings."""
    return _make("simulator", name, settings)  # type: ignore[no-any-return]


def make_importer(name: str) -> Importer:
    """Make the importer of a name."""
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
