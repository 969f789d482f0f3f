"""Plugins by entry point, such as backbones, memories and policies, those of persist itself too.

Listing plugins imports none. Loading imports one and checks that its class can be used; any failure, here or later in
one of its methods, becomes one line that names plugin, package, version, target and cause.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import inspect
import json
import re
import sys
from collections.abc import Iterator, Set
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import EntryPoint, distributions, entry_points
from pathlib import Path
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from persist_cli.errors import TRACEBACK, DataError, PersistError, PluginError, RecipeError, hint

if TYPE_CHECKING:
    from persist_cli.api.backbone import Backbone
    from persist_cli.api.cost import Cost
    from persist_cli.api.encoder import Encoder
    from persist_cli.api.importer import Importer
    from persist_cli.api.memory import FrameOfReference, Memory
    from persist_cli.api.policy import Policy
    from persist_cli.api.policy_network import PolicyNetwork
    from persist_cli.api.scene_model import SceneModel
    from persist_cli.api.simulator import Simulator


class PluginKind(NamedTuple):
    """A kind of plugin: the group of its entry points, its abstract base class, and what it is made from."""

    group: str
    base: str
    arguments: tuple[str, ...]


KINDS: Final = {
    "backbone": PluginKind("persist.backbones", "persist_cli.api.backbone:Backbone", ("settings",)),
    "memory": PluginKind("persist.memories", "persist_cli.api.memory:Memory", ("settings", "encoder", "reference")),
    "encoder": PluginKind("persist.encoders", "persist_cli.api.encoder:Encoder", ("settings",)),
    "simulator": PluginKind("persist.simulators", "persist_cli.api.simulator:Simulator", ("settings",)),
    "importer": PluginKind("persist.importers", "persist_cli.api.importer:Importer", ("settings",)),
    "policy": PluginKind("persist.policies", "persist_cli.api.policy:Policy", ("settings",)),
    "cost": PluginKind("persist.costs", "persist_cli.api.cost:Cost", ("settings",)),
    "scene model": PluginKind("persist.scene_models", "persist_cli.api.scene_model:SceneModel", ("settings",)),
}

NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")  # it names folders, and stands in lists with commas

RESERVED: Final = {"memory": ("stage1", "simulator")}  # words for what stands among memories in tables

OWN: Final = ("persist_cli", "persist_backbones", "persist_memory")  # packages whose errors are bugs of ours


@dataclass(frozen=True, order=True)
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

    @property
    def module(self) -> str:
        """The outermost package of its module."""
        return self.target.partition(":")[0].partition(".")[0]

    def error(self, message: str, cause: str) -> PluginError:
        """An error of this plugin, whose line names it."""
        return PluginError(f"{self} {message}", self.package, self.target, cause)

    def __str__(self) -> str:
        return f"{self.kind} {self.name!r} ({self.package} {self.version}, {self.target})"


_LOADED: Final[dict[type, Plugin]] = {}  # by their classes


def list_plugins(kind: str) -> list[Plugin]:
    """All installed plugins of a kind, sorted by name; none is imported."""
    return list(_list_plugins(kind, _places()))


def list_misplaced() -> list[tuple[Plugin, str]]:
    """The entry points of groups such as ``persist.memory`` that are none of ``KINDS``, and what is wrong with each.

    The kind of these plugins is the group.
    """
    groups = [kind.group for kind in KINDS.values()]
    entries = {entry for installed in distributions() for entry in installed.entry_points}
    return sorted(
        (_describe(entry.group, entry), f"there is no group {entry.group!r}; {hint(entry.group, groups, 'groups')}")
        for entry in entries
        if entry.group.startswith("persist.") and entry.group not in groups
    )


def find_plugin(kind: str, name: str) -> Plugin:
    """The plugin of a name, which is not imported yet.

    Raises:
        PluginError: when the name is unknown or claimed by two packages.
    """
    installed = list_plugins(kind)
    plugins = [plugin for plugin in installed if plugin.name == name]
    if not plugins:
        for plugin, cause in list_misplaced():
            if plugin.name == name:
                raise PluginError(f"{plugin.package} {plugin.version} has no {kind} {name!r}: {cause}", plugin.package)
        names = sorted({plugin.name for plugin in installed})
        raise PluginError(f"unknown {kind} {name!r}; {hint(name, names, 'installed')}")
    if len(plugins) > 1:
        packages = " and ".join(plugin.package for plugin in plugins)
        others = [plugin.package for plugin in plugins if plugin.module not in OWN]
        superfluous = others[0] if len(others) == 1 else "all but one of them"
        raise PluginError(f"{kind} {name!r} is claimed by {packages}; uninstall {superfluous}")
    return plugins[0]


def _places() -> tuple[tuple[str, int], ...]:
    """Where packages are installed, and when one was last added or removed there."""
    folders = (folder for folder in map(Path, sys.path) if folder.is_dir())
    return tuple((str(folder), folder.stat().st_mtime_ns) for folder in folders)


@lru_cache(maxsize=len(KINDS))
def _list_plugins(kind: str, places: tuple[tuple[str, int], ...]) -> tuple[Plugin, ...]:
    """As ``list_plugins``, once for as long as the places are the same: it reads the metadata of all packages."""
    del places
    plugins = {_describe(kind, entry) for entry in entry_points(group=KINDS[kind].group)}
    return tuple(sorted(plugins, key=lambda plugin: (plugin.name, plugin.package)))


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
    base = _resolve(KINDS[plugin.kind].base)
    if cause := _wrong_entry(plugin):
        raise plugin.error(f"is broken: {cause}", cause)
    try:
        with contextlib.redirect_stdout(sys.stderr):  # standard output is for what the command prints
            loaded = _resolve(plugin.target)
    except (Exception, SystemExit) as error:  # the module of another package may raise anything
        raise plugin.error(f"is broken: {first_line(error)}", first_line(error)) from error
    cause = _flaw(loaded, base, KINDS[plugin.kind])
    if cause:
        raise plugin.error(f"is broken: {cause}", cause)
    other = _LOADED.setdefault(loaded, plugin).name
    if other != plugin.name:
        cause = f"its class is that of {other!r} too; each name needs one of its own"
        raise plugin.error(f"is broken: {cause}", cause)
    loaded.name = plugin.name
    return loaded  # type: ignore[no-any-return]


def _wrong_entry(plugin: Plugin) -> str:
    """Why an entry point can name no plugin, empty when it can."""
    if not plugin.target.partition(":")[2]:
        return "its entry point names no class; write module:class"
    if not NAME.fullmatch(plugin.name):
        return "a name has letters, digits, '.', '_' and '-', a letter or digit first"
    return "its name has another meaning; choose another" if plugin.name in RESERVED.get(plugin.kind, ()) else ""


def _flaw(loaded: Any, base: type, kind: PluginKind) -> str:
    """Why something is no class of plugins of this kind that can be made, empty when it is one."""
    if not (isinstance(loaded, type) and issubclass(loaded, base)):
        return f"it is no subclass of {kind.base.replace(':', '.')}"
    missing = sorted(getattr(loaded, "__abstractmethods__", ()))
    if missing:
        return f"it lacks {', '.join(missing)}, which {base.__name__} leaves to its subclasses"
    if "settings" in kind.arguments and not dataclasses.is_dataclass(getattr(loaded, "settings_type", None)):
        return "its settings_type is no dataclass"
    try:
        inspect.signature(loaded).bind(*kind.arguments)
    except TypeError:
        return f"its __init__ does not take ({', '.join(kind.arguments)})"
    return next(filter(None, (_wrong_member(loaded, base, name) for name in vars(base) if name[0] != "_")), "")


def _wrong_member(loaded: type, base: type, name: str) -> str:
    """Why what a class has in place of a method or value of its base cannot stand for it, empty when it can."""
    own, given = inspect.getattr_static(base, name), inspect.getattr_static(loaded, name)
    if given is own or (hasattr(given, "__get__") and not callable(given)):  # a property, or a class method
        return ""
    if isinstance(own, property | classmethod):
        word = "property" if isinstance(own, property) else "classmethod"
        return f"its {name} is a plain method; write @{word} above it" if inspect.isfunction(given) else ""
    if isinstance(own, bool | int | str | frozenset):
        kind = Set if isinstance(own, frozenset) else type(own)
        return "" if isinstance(given, kind) else f"its {name} is {given!r}, no {type(own).__name__}"
    if not inspect.isfunction(own):
        return ""
    wanted = list(inspect.signature(own).parameters.values())
    passed = wanted[1:] if isinstance(given, staticmethod) else wanted
    try:
        inspect.signature(getattr(loaded, name)).bind(
            *(part.name for part in passed if part.kind is part.POSITIONAL_OR_KEYWORD),
            **{part.name: part for part in passed if part.kind is part.KEYWORD_ONLY},
        )
    except TypeError:
        return f"its {name} does not take ({', '.join(part.name for part in wanted[1:])})"
    except ValueError:  # a function of a compiled module may not say what it takes
        return ""
    return ""


@contextlib.contextmanager
def faults_of(kind: str, name: str) -> Iterator[None]:
    """Within the block, what a check finds wrong is the fault of a plugin, which gave it.

    Args:
        kind: kind of the plugin, such as ``importer``.
        name: name of the plugin.

    Raises:
        PluginError: naming the plugin, from a ``DataError``.
    """
    try:
        yield
    except DataError as error:
        raise find_plugin(kind, name).error(f"is broken: {error}", str(error)) from error


@contextlib.contextmanager
def plugin_errors() -> Iterator[None]:
    """Within the block, what a plugin of another package raises is one line that says in which method and where.

    Whatever passes through no method of such a plugin is a bug of persist, and stays as it is.

    Raises:
        PluginError: from an exception that is no ``PersistError`` and passed through a plugin of another package.
    """
    try:
        yield
    except PersistError:
        raise
    except (Exception, SystemExit) as error:  # a plugin may raise anything
        blamed = _blame(error)
        if blamed is None:
            raise
        raise blamed from error


def _blame(error: BaseException) -> PluginError | None:
    """The error of the innermost plugin that an exception passed through, ``None`` when it passed through none."""
    plugins = [plugin for kind in KINDS for plugin in list_plugins(kind) if plugin.module not in OWN]
    modules = {plugin.module for plugin in plugins}
    inside = [(frame, line) for frame, line in _frames(error.__traceback__) if _package_of(frame) in modules]
    if not inside:
        return None
    owners = [_owner(frame) for frame, _ in inside]
    owner = next(filter(None, reversed(owners)), None)
    callers = [index for index, other in enumerate(owners) if other not in (None, owner)]
    entered = inside[owners.index(owner, callers[-1] + 1 if callers else 0)][0]
    innermost, line = inside[-1]
    method = entered.f_code.co_qualname
    if callers:
        method += f", called in {inside[callers[-1]][0].f_code.co_qualname}"
    cause = f"{first_line(error)} ({innermost.f_code.co_filename}:{line})"
    failed = f"failed in {method}: {cause}; set {TRACEBACK}=1 for the whole traceback"
    of_package = [plugin for plugin in plugins if plugin.module == _package_of(entered)]
    if owner or len(of_package) == 1:
        return (owner or of_package[0]).error(failed, cause)
    package = of_package[0]
    return PluginError(f"package {package.package} {package.version} {failed}", package.package, cause=cause)


def _owner(frame: FrameType) -> Plugin | None:
    """The plugin whose method a frame runs, also where its class inherits the method; ``None`` for other code."""
    first = frame.f_locals.get(frame.f_code.co_varnames[0]) if frame.f_code.co_argcount else None
    return _LOADED.get(first if isinstance(first, type) else type(first))


def _frames(place: TracebackType | None) -> Iterator[tuple[FrameType, int]]:
    """The frames of a traceback and their lines, the outermost first."""
    while place is not None:
        yield place.tb_frame, place.tb_lineno
        place = place.tb_next


def _package_of(frame: FrameType) -> str:
    return str(frame.f_globals.get("__name__", "")).partition(".")[0]


def first_line(error: BaseException) -> str:
    """The class and the first line of an exception."""
    return f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else 'no message'}"


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


def check_simulator(name: str) -> None:
    """Raise ``PluginError`` when the simulator of a name cannot be used before something is installed."""
    needs = load_plugin("simulator", name).missing()
    if needs:
        raise PluginError(f"simulator {name!r} {needs}")


def make_importer(name: str, settings: dict[str, Any]) -> Importer:
    """Make the importer of a name with plain settings."""
    return _make("importer", name, settings)  # type: ignore[no-any-return]


def make_policy(name: str, settings: dict[str, Any]) -> Policy:
    """Make the policy of a name with plain settings."""
    from persist_cli.api.promises import check_policy

    policy: Policy = _make("policy", name, settings)
    check_policy(policy)
    return policy


def network_type(policy: str) -> type[PolicyNetwork]:
    """The class of the network that is trained for the policy of a name.

    Raises:
        RecipeError: when that policy is not trained.
    """
    loaded: type[PolicyNetwork] | None = load_plugin("policy", policy).network_type
    if loaded is None:
        raise RecipeError(f"policy {policy!r} has no network to train; 'nomad' has one")
    return loaded


def make_cost(name: str, settings: dict[str, Any]) -> Cost:
    """Make the cost of a name with plain settings."""
    return _make("cost", name, settings)  # type: ignore[no-any-return]


def make_scene_model(name: str, settings: dict[str, Any]) -> SceneModel:
    """Make the model of scenes of a name with plain settings and fresh weights."""
    from persist_cli.api.scene_model import SceneForm

    model: SceneModel = _make("scene model", name, settings)
    if not isinstance(model.form, SceneForm):
        cause = f"its form is a {type(model.form).__name__}, no SceneForm"
        raise find_plugin("scene model", name).error(f"is broken: {cause}", cause)
    return model


def make_settings(kind: str, name: str, settings: dict[str, Any]) -> Any:
    """Make the settings of a plugin from plain values.

    Raises:
        PersistError: one line with all unknown keys and wrong values.
    """
    from persist_cli.io.settings import parse_settings

    kind_of_settings, where = load_plugin(kind, name).settings_type, f"{kind} {name!r}"
    try:
        made = parse_settings(kind_of_settings, settings, where)
        kept = json.loads(json.dumps(dataclasses.asdict(made)))  # as in cards and memory files
    except PersistError:
        raise
    except Exception as error:  # what pydantic cannot read, or what JSON cannot hold
        cause = f"its settings cannot be used: {first_line(error)}"
        raise find_plugin(kind, name).error(f"is broken: {cause}", cause) from error
    try:
        parse_settings(kind_of_settings, kept, where)
    except RecipeError as error:  # defaults are not checked when settings are made
        cause = f"its settings cannot be read again: {str(error).removeprefix(f'{where}: ')}"
        raise find_plugin(kind, name).error(f"is broken: {cause}", cause) from error
    return made


def _make(kind: str, name: str, settings: dict[str, Any], *rest: Any) -> Any:
    return load_plugin(kind, name)(make_settings(kind, name, settings), *rest)


def _describe(kind: str, entry: EntryPoint) -> Plugin:
    package, version = (entry.dist.name, entry.dist.version) if entry.dist else ("unknown package", "?")
    return Plugin(kind, entry.name, entry.value, package, version)


def _resolve(target: str) -> Any:
    module, _, attribute = target.partition(":")
    return getattr(importlib.import_module(module), attribute)
