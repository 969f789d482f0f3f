"""A walk keeps a bounded part of its past, however long it is."""

from __future__ import annotations

from persist_cli.play import history, recording, surveyor
from tests.play.test_play import FORWARD, LEFT, play_on, walked
from tests.support.micro_worlds import remembering_model


def test_a_long_walk_keeps_a_bounded_past(walks, monkeypatch):
    monkeypatch.setattr(surveyor, "MOST_PLACES", 50)
    monkeypatch.setattr(recording, "LONGEST", 40)
    play = play_on(remembering_model(), walks)
    play.record()
    for _ in range(12):
        walked(play, LEFT, 12)
        walked(play, FORWARD, 8)
    assert play.shown.number == 240
    walkers = play._walkers
    kept = sum(len(steps) for _, steps in walkers._history._parts)
    assert kept <= 2 * history.UNDO + 2 * walkers.longest
    assert len(walkers._history._parts) == 2
    assert all(len(shown) <= walkers.longest for shown in walkers._shown)
    assert len(play._surveyor._way) == 50
    assert play.recording_is_full
    assert len(play._recording) == 40
    assert not walkers.lead.reads[1:]
