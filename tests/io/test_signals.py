"""Signals that ask a program to stop."""

from __future__ import annotations

import signal

import pytest

from persist_cli.io.signals import STOPPING, caught_signals


@pytest.mark.parametrize("number", STOPPING)
def test_a_signal_is_caught_within_the_block_alone_and_one_that_was_ignored_stays_ignored(number):
    caught: list[int] = []
    before = signal.getsignal(number)
    with caught_signals(lambda sent, _: caught.append(sent)):
        signal.raise_signal(number)
    assert (caught, signal.getsignal(number)) == ([number], before)
    signal.signal(number, signal.SIG_IGN)
    try:
        with caught_signals(lambda sent, _: caught.append(sent)):
            signal.raise_signal(number)
        assert (caught, signal.getsignal(number)) == ([number], signal.SIG_IGN)
    finally:
        signal.signal(number, before)
