"""Imports in parts: a module is imported, and modules that it names but does not need yet wait for their first use.

Python executes all that a module imports. diffusers' CogVideoX names hundreds of modules (the other models, their
hooks, transformers, torch's compiler), of which a rollout uses none; executing them takes longer than the rollout.
"""

from __future__ import annotations

import contextlib
import importlib
import sys
from collections.abc import Iterator, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType
from typing import Any


@contextlib.contextmanager
def deferred_imports(modules: Sequence[str], left_out: Sequence[str] = ()) -> Iterator[None]:
    """Within the block these modules are not executed; what is imported from them is a stand-in until it is used.

    After the block they are imported as always. A module that was imported before is not touched, and neither are
    submodules: they are executed, in a package that is not.

    Args:
        modules: full names of modules, of which classes, functions and submodules may be imported within the block.
        left_out: full names of modules within which nothing is found, so that whoever imports takes its way without
            them (``except ImportError``).
    """
    finder = _Finder({name: name in left_out for name in (*modules, *left_out) if name not in sys.modules})
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)
        for name in finder.waiting:
            _forget(name)


class _Finder(MetaPathFinder):
    """Finds modules as always, but leaves them unexecuted.

    Args:
        waiting: names of the modules, and whether nothing is found within them.
    """

    def __init__(self, waiting: dict[str, bool]) -> None:
        self.waiting = waiting

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        """The module's own spec with a loader that does not execute it, ``None`` for all other modules."""
        spec = PathFinder.find_spec(name, path, target) if name in self.waiting else None
        if spec is not None:
            spec.loader = _UnexecutedLoader(self.waiting[name])
        return spec


class _UnexecutedLoader(Loader):
    def __init__(self, left_out: bool) -> None:
        self.left_out = left_out

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return ModuleType(spec.name) if self.left_out else _WaitingModule(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        """Do nothing: the module is executed when something of it is used."""


class _WaitingModule(ModuleType):
    """A module that was not executed; what is taken from it is a stand-in."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if sys.modules.get(self.__name__) is not self:  # after the block
            return getattr(importlib.import_module(self.__name__), name)
        return _StandIn(name, (), {"__module__": self.__name__})


class _StandIn(type):
    """A class in the place of a class or function that was not imported yet, which it finds when it is used."""

    def found(cls) -> Any:
        """The class or function itself."""
        return getattr(importlib.import_module(cls.__module__), cls.__name__)

    def __call__(cls, *args: Any, **kwargs: Any) -> Any:
        return cls.found()(*args, **kwargs)

    def __getattr__(cls, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(cls.found(), name)

    def __instancecheck__(cls, instance: Any) -> bool:
        return isinstance(instance, cls.found())

    def __subclasscheck__(cls, subclass: type) -> bool:
        return issubclass(subclass, cls.found())


def _forget(name: str) -> None:
    """Take an unexecuted module out of the modules that are imported, so that the next import executes it."""
    module = sys.modules.get(name)
    if module is None or not isinstance(getattr(module.__spec__, "loader", None), _UnexecutedLoader):
        return
    del sys.modules[name]
    parent, _, leaf = name.rpartition(".")
    if vars(sys.modules.get(parent, module)).get(leaf) is module:
        delattr(sys.modules[parent], leaf)
