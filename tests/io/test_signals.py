"""Signals that ask a program to stop."""

from __future__ import annotations

import signal

import pytest

from persist_cli.io.signals import STOPPING, caught_signals, repeated_signals


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


@pytest.mark.parametrize(
    ("again", "ended"), [(0, [signal.SIGINT]), (60, [])], ids=["the second one", "one on two ways"]
)
def test_a_signal_that_comes_again_ends_a_program_unless_it_is_the_same_on_two_ways(monkeypatch, again, ended):
    monkeypatch.setattr("persist_cli.io.signals.AGAIN", again)
    ends: list[int] = []
    with caught_signals(lambda *_: None), repeated_signals(ends.append):
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGHUP, signal.SIGINT):
            signal.raise_signal(number)  # a launcher ends with SIGTERM what Ctrl-C stopped; terminals send SIGHUP twice
    assert ends == ended
    assert signal.set_wakeup_fd(-1) == -1
