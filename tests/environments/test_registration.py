"""An import registers the environments, and without gymnasium says how to install it."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import sys
sys.modules["gymnasium"] = None
from persist_cli.errors import PluginError
try:
    import persist_cli.environments
except PluginError as error:
    print(error)
"""


def test_the_name_of_a_module_in_front_of_an_environment_is_enough_to_make_it():
    program = "import gymnasium; gymnasium.make('persist_cli.environments:persist/SimulatedHouse-v0', sceens='0:2')"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert "unknown key 'sceens', did you mean 'scenes'?" in ended.stderr


def test_without_gymnasium_one_line_says_which_extra_is_needed():
    ended = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    assert ended.stdout == "the environments need the package gymnasium: pip install 'persist-cli[gym]'\n"
