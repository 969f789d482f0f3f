"""Weights of others: whether the Hugging Face hub is in reach, where what is fetched is kept, and quiet loading."""

from __future__ import annotations

import contextlib
import functools
import os
import ssl
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from persist_cli.errors import PersistError

TIMEOUT: Final = 3.0  # seconds

MODEL_FILES: Final = ("config.json", "model.safetensors")


def hub_obstacle() -> str | None:
    """The reason why the hub is out of reach, ``None`` when it answers; each process tries once."""
    from huggingface_hub import constants

    return "HF_HUB_OFFLINE is set" if constants.HF_HUB_OFFLINE else _connection_failure(constants.ENDPOINT)


def in_hub_cache(repository: str) -> bool:
    """Whether the hub's own cache holds a model's configuration and weights, so that no network is needed."""
    from huggingface_hub import try_to_load_from_cache

    return all(isinstance(try_to_load_from_cache(repository, name), str) for name in MODEL_FILES)


@functools.cache
def _connection_failure(endpoint: str) -> str | None:
    import http.client
    import urllib.error
    import urllib.request

    try:
        urllib.request.urlopen(urllib.request.Request(endpoint, method="HEAD"), timeout=TIMEOUT).close()
    except urllib.error.HTTPError:
        return None  # it answers; the hub's client deals with the error
    except (OSError, http.client.HTTPException, ValueError) as error:
        reason = getattr(error, "reason", error)
        if isinstance(reason, ssl.SSLError):
            return None  # the hub's client has certificates of its own
        return f"{endpoint} does not answer ({reason})"
    return None


@contextlib.contextmanager
def without_bars() -> Iterator[None]:
    """Within the block transformers draws no progress bars for the weights that it loads."""
    from transformers.utils import logging as transformers_logging

    enabled = transformers_logging.is_progress_bar_enabled()
    transformers_logging.disable_progress_bar()
    try:
        yield
    finally:
        if enabled:
            transformers_logging.enable_progress_bar()


def cache_home() -> Path:
    """The folder of all that is fetched: ``$PERSIST_CACHE``, else a folder in the user's cache.

    Raises:
        PersistError: when the user has no home folder, as a user of a container without a name.
    """
    cache = os.environ.get("PERSIST_CACHE")
    if cache:
        return Path(cache)
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "persist"
    except RuntimeError as error:
        raise PersistError(
            "this user has no home folder to keep weights and data in; set PERSIST_CACHE to a folder"
        ) from error


def weights_home() -> Path:
    """The folder of all fetched weights; errors as those of ``cache_home``."""
    return cache_home() / "weights"


def cached_weight(name: str) -> Path | None:
    """The folder of weights by their name in ``persist weights list``, ``None`` when they are not fetched yet."""
    try:
        folder = weights_home() / name
    except PersistError:
        return None
    return folder if (folder / "weight.json").is_file() else None
