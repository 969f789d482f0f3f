"""Parquet files: what a missing or damaged one raises, as one line, and their columns by name."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pyarrow as pa

from persist_cli.errors import DataError

SUFFIX: Final = ".parquet"


@contextlib.contextmanager
def parquet_errors(path: Path) -> Iterator[None]:
    """Within the block, whatever a missing or damaged file raises becomes a ``DataError`` that names it."""
    try:
        yield
    except FileNotFoundError as error:
        raise DataError(f"{path}: no such file") from error
    except UnicodeEncodeError:  # of the path, which the command names
        raise
    except (pa.ArrowException, OSError, ValueError, OverflowError) as error:
        cause = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DataError(f"{path}: not a whole Parquet file ({cause})") from error


def column(table: pa.Table | pa.RecordBatch, name: str, path: Path) -> pa.ChunkedArray | pa.Array:
    """The column of a name; ``DataError`` unless there is just one of it in what was read of the file."""
    count = table.schema.names.count(name)
    if count != 1:
        raise DataError(f"{path}: {f'{count} columns' if count else 'no column'} {name!r}")
    return table.column(name)
