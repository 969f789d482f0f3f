"""An import registers the environments, and without gymnasium says how to install it."""

from __future__ import annotations

import importlib
import sys

import gymnasium
import pytest

import persist_cli.environments  # noqa: F401  so that all is put back that is taken away
from persist_cli.errors import PersistError, PluginError


@pytest.fixture(autouse=True)
def _not_imported(monkeypatch):
    """No environment is registered, and no module of theirs imported."""
    for name in [name for name in gymnasium.registry if name.startswith("persist/")]:
        monkeypatch.delitem(gymnasium.registry, name)
    before = environment_modules()
    for name in before:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr("persist_cli.environments", None, raising=False)
    yield
    for name in set(environment_modules()) - set(before):  # the others are put back
        del sys.modules[name]


def environment_modules():
    return [name for name in sys.modules if name.startswith("persist_cli.environments")]


def test_the_name_of_a_module_in_front_of_an_environment_is_enough_to_make_it():
    with pytest.raises(PersistError, match="unknown key 'sceens', did you mean 'scenes'"):
        gymnasium.make("persist_cli.environments:persist/SimulatedHouse-v0", sceens="0:2")


def test_without_gymnasium_one_line_says_which_extra_is_needed(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(PluginError) as error:
        importlib.import_module("persist_cli.environments")
    assert str(error.value) == "the environments need the package gymnasium: pip install 'persist-cli[gym]'"
