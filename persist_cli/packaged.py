"""The reference model and the sample data that come with the package.

Both are folders of ``persist_recipes``, ``reference/`` and ``sample/``; the environment variable ``PERSIST_REFERENCE``
names another folder that holds the two.
"""

from __future__ import annotations

import os
from importlib import resources
from pathlib import Path

from persist_cli.checkpoints import CARD
from persist_cli.trajectories.store import SUFFIX
from persist_cli.world.errors import CheckpointError, DataError

ENVIRONMENT = "PERSIST_REFERENCE"


def reference_checkpoint() -> Path:
    """The folder of the reference model, a checkpoint with an adapter for each memory.

    Raises:
        CheckpointError: when this installation has none.
    """
    folder = _home() / "reference"
    if not (folder / CARD).is_file():
        raise CheckpointError(f"no reference model in {folder}: it comes with the package; give a CHECKPOINT")
    return folder


def sample_data() -> Path:
    """The folder of the sample data set: held-out houses, there and back.

    Raises:
        DataError: when this installation has none.
    """
    folder = _home() / "sample"
    if not any(folder.glob(f"*{SUFFIX}")):
        raise DataError(f"no sample data in {folder}: it comes with the package; give the folder of a data set")
    return folder


def _home() -> Path:
    named = os.environ.get(ENVIRONMENT)
    return Path(named) if named else Path(str(resources.files("persist_recipes")))
