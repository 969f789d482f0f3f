"""The reference model and the sample data that come with the package.

Both are folders of ``persist_recipes``, ``reference/`` and ``sample/``; the environment variable ``PERSIST_REFERENCE``
names another folder that holds the two.
"""

from __future__ import annotations

import os
from importlib import resources
from pathlib import Path

ENVIRONMENT = "PERSIST_REFERENCE"


def bundled_folder(name: str) -> Path:
    """A folder of this name beside the recipes, or where the environment variable says; it may not be there."""
    named = os.environ.get(ENVIRONMENT)
    home = Path(named) if named else Path(str(resources.files("persist_recipes")))
    return home / name
