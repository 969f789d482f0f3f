"""Environments for these tests."""

from __future__ import annotations

import warnings
from collections.abc import Iterator

import pytest

from tests.support.micro_runs import write_walks


@pytest.fixture(autouse=True)
def no_warnings() -> Iterator[None]:
    """Let Gymnasium's warnings, which its checker gives where it has doubts, fail a test."""
    with warnings.catch_warnings():
        warnings.filterwarnings("error", module="gymnasium")
        yield


@pytest.fixture
def packaged(tmp_path_factory, monkeypatch) -> dict[str, object]:
    """An imagined house of the packaged model without memory, whose images are large enough for networks of images."""
    monkeypatch.delenv("PERSIST_REFERENCE", raising=False)
    walks = write_walks(tmp_path_factory.mktemp("walks"), size=64)
    return {
        "id": "persist/ImaginedHouse-v0", "start": f"{walks}#0:6", "goal": f"{walks}#0:0-9", "adapter": "stage1",
        "sampling": {"steps": 1}, "success_radius": 0.1, "goal_distance": [0.15, 5.0],
    }  # fmt: skip
