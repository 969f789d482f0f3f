from __future__ import annotations

import os

from persist_cli.play.sessions import Limits
from persist_cli.reproduce.pages import ServedPage
from tests.benchmarks.bench_play_server import measured
from tests.support.micro_plays import micro_walks
from tests.support.play_pages import serving


def test_two_pages_are_measured_at_once(walks):
    with serving(micro_walks(walks), Limits(frames_per_second=60)) as served:
        load = measured(ServedPage(served.address, os.getpid()), sessions=2, presses=1, hold=3)
    assert load.frames >= 2 * (1 + 2 * 3)
    assert 0 < load.latency <= load.latency_95
    assert load.rate > 0
    assert load.processor > 0
