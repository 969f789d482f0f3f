from __future__ import annotations

import os

import numpy as np
import pytest

from persist_cli.errors import PersistError
from persist_cli.play.sessions import Limits
from persist_cli.reproduce.pages import CHROMIUM, ServedPage
from tests.benchmarks import bench_play_page
from tests.benchmarks.bench_play_page import measured
from tests.support.micro_plays import micro_walks
from tests.support.play_pages import serving
from tests.support.scripted_walks import ScriptedWalks
from tests.support.scripted_walks import serving as scripted


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
def test_keys_are_measured_at_the_start_and_after_a_walk(walks):
    with serving(micro_walks(walks), Limits(frames_per_second=60)) as served:
        first, later = measured(ServedPage(served.address, os.getpid()), presses=1, hold=2, after=24)
    assert first.presses == later.presses == first.answered == later.answered == 1
    assert 0 < first.latency <= first.latency_95
    assert first.rate > 0
    assert first.after < 24 <= later.after


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
def test_a_page_that_draws_no_more_frames_ends_the_benchmark(monkeypatch):
    monkeypatch.setattr(bench_play_page, "STUCK", 1.0)
    walks = ScriptedWalks({"none": [np.full((16, 16, 3), 250, np.uint8)]})
    walks.answering = False
    with scripted(walks) as address, pytest.raises(PersistError, match="has drawn no frame in 1 s"):
        measured(ServedPage(address, os.getpid()), presses=1, hold=2, after=24)
