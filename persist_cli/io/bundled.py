"""The reference model and the sample data that come with the package.

Both are folders of ``persist_recipes``, ``reference/`` and ``sample/``; the environment variable ``PERSIST_REFERENCE``
names another folder that holds the two.
"""

from __future__ import annotations

import os
from importlib import resources
from pathlib import Path
from typing import Final

ENVIRONMENT: Final = "PERSIST_REFERENCE"


def bundled_folder(name: str) -> Path:
    """The folder of this name beside the recipes, or where the environment variable says; it need not exist."""
    return Path(os.environ.get(ENVIRONMENT) or str(resources.files("persist_recipes"))) / name
