"""Environments for these tests."""

from __future__ import annotations

import warnings
from collections.abc import Iterator

import pytest


@pytest.fixture(autouse=True)
def no_warnings() -> Iterator[None]:
    """Let Gymnasium's warnings, which its checker gives where it has doubts, fail a test."""
    with warnings.catch_warnings():
        warnings.filterwarnings("error", module="gymnasium")
        yield
