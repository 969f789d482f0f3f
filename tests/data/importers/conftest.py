"""A LeRobot dataset for several files of tests."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.support.lerobot_datasets import write_lerobot


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_lerobot(tmp_path_factory.mktemp("lerobot") / "room")


@pytest.fixture
def dataset(written: Path, tmp_path: Path) -> Path:
    """Two episodes, of 4 and 3 frames, with videos."""
    return Path(shutil.copytree(written, tmp_path / "room"))
