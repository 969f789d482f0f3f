"""Parquet files: what a missing or damaged one raises, as one line."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa

from persist_cli.errors import DataError


@contextlib.contextmanager
def parquet_errors(path: Path) -> Iterator[None]:
    """Within the block, whatever a missing or damaged file raises becomes a ``DataError`` that names it."""
    try:
        yield
    except FileNotFoundError as error:
        raise DataError(f"{path}: no such file") from error
    except (pa.ArrowException, OSError) as error:
        cause = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DataError(f"{path}: not a whole Parquet file ({cause})") from error
