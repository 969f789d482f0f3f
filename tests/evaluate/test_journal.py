"""The journal of an evaluation goes on only where its numbers of rows mean the same rows."""

from __future__ import annotations

from pathlib import Path

import pytest

from persist_cli.errors import DataError
from persist_cli.evaluate.journal import Journal


def test_a_journal_with_another_number_of_rows_is_refused_since_numbers_would_mean_others(tmp_path: Path):
    journal = Journal(tmp_path)
    journal.folder.mkdir()
    journal.name_rows(["voxel", "geometric warp", "codec reconstruction"])
    with pytest.raises(DataError, match="with 3 rows and not 2"):
        journal.name_rows(["voxel", "codec reconstruction"])
