"""Where weights that ``persist weights fetch`` converted are kept, for whoever needs them by name.

A weight is a folder of the user's cache: ``model.safetensors``, for some ``config.json`` in transformers' form, and
``weight.json`` that says where it came from.
"""

from __future__ import annotations

import os
from pathlib import Path


def weights_home() -> Path:
    """The folder of all cached weights: ``$PERSIST_CACHE/weights``, else below the user's cache folder."""
    cache = os.environ.get("PERSIST_CACHE")
    if cache:
        return Path(cache) / "weights"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "persist" / "weights"


def cached_weight(name: str) -> Path | None:
    """The folder of a weight by its name in ``persist weights list``; ``None`` when it was not fetched yet."""
    folder = weights_home() / name
    return folder if (folder / "weight.json").is_file() else None
