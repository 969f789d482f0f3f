"""A trained policy of the smallest sizes."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.micro_policies import policy_stage
from tests.support.micro_runs import run_persist


@pytest.fixture(scope="session")
def policy_run(walks: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of four steps of the micro network."""
    run = tmp_path_factory.mktemp("policies") / "policy"
    run_persist(*policy_stage(walks, run))
    return run
