"""Libraries that say on standard error what we say ourselves, or nobody has asked."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator


@contextlib.contextmanager
def silent(name: str) -> Iterator[None]:
    """Within the block the logger of this name says nothing."""
    logger = logging.getLogger(name)
    before, logger.disabled = logger.disabled, True
    try:
        yield
    finally:
        logger.disabled = before


@contextlib.contextmanager
def without_bars() -> Iterator[None]:
    """Within the block transformers draws no progress bars of the weights that it loads."""
    from transformers.utils import logging as theirs

    before = theirs.is_progress_bar_enabled()
    theirs.disable_progress_bar()
    try:
        yield
    finally:
        if before:
            theirs.enable_progress_bar()
