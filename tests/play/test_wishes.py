"""The newest keys count, frames keep their pace, and a page may not say too much."""

from __future__ import annotations

import pytest

from persist_cli.errors import PersistError
from persist_cli.play.messages import Ack, ChangeSettings, Home, Jump, Keys, Undo
from persist_cli.play.wishes import Allowance, HeldActions, Pace, Wishes


class Clock:
    """Stands still until it is set."""

    now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


def test_the_newest_held_actions_count():
    keys = HeldActions()
    keys.hold(["forward"])
    keys.hold(["forward", "left"])
    assert keys.take() == ({"forward", "left"}, {"forward", "left"})
    assert keys.take() == ({"forward", "left"}, set())
    keys.hold([])
    assert keys.take() == (set(), set())


def test_what_was_let_go_before_it_acted_acts_once_and_one_at_a_time():
    keys = HeldActions()
    for held in (["forward"], ["forward", "toggle"], ["forward", "left"], ["forward"]):
        keys.hold(held)
    assert keys.take() == ({"forward"}, {"forward", "toggle"})
    assert keys.take() == ({"forward"}, {"left"})
    assert keys.take() == ({"forward"}, set())


def test_what_is_let_go_and_held_again_counts_as_newly_pressed():
    keys = HeldActions()
    keys.hold(["toggle"])
    keys.take()
    keys.hold([])
    keys.hold(["toggle"])
    assert keys.take() == ({"toggle"}, {"toggle"})


def test_two_frames_may_be_on_the_way(clock):
    pace = Pace(10, clock)
    assert (pace.send(), pace.is_open) == (1, True)
    assert (pace.send(), pace.is_open) == (2, False)
    pace.draw(1)
    assert pace.is_open
    pace.draw(99)  # never sent
    assert (pace.send(), pace.send(), pace.is_open) == (3, 4, False)


def test_frames_come_at_their_rate_and_not_in_bursts(clock):
    pace = Pace(10, clock)
    pace.send()
    clock.now += 60
    begun = clock.now
    pace.send()
    assert pace.wait == pytest.approx(0.05)
    for _ in range(50):
        clock.now += pace.wait
        pace.send()
        pace.draw(pace.sent)
    assert clock.now - begun == pytest.approx(5, abs=0.1)


def test_a_page_may_say_so_much_at_once_and_again_after_a_while(clock):
    allowance = Allowance(3, 10, clock)
    assert [allowance.spend() for _ in range(4)] == [True, True, True, False]
    clock.now += 0.2
    assert [allowance.spend() for _ in range(3)] == [True, True, False]


def test_a_command_takes_the_place_of_one_of_its_kind_that_waits():
    wishes = Wishes(Pace(10))
    for message in (
        ChangeSettings(steps=1, seed=3),
        ChangeSettings(steps=2),
        Jump(x=1, y=1),
        Jump(x=2, y=2),
        Undo(),
        Undo(),
    ):
        wishes.hear(message)
    assert list(wishes.commands) == [ChangeSettings(steps=2, seed=3), Jump(x=2, y=2), Undo(), Undo()]


def test_too_many_commands_are_refused():
    wishes = Wishes(Pace(10))
    for _ in range(16):
        wishes.hear(Undo())
    with pytest.raises(PersistError, match="16 commands wait already"):
        wishes.hear(Home())


def test_keys_and_drawn_frames_wake_the_walk():
    wishes = Wishes(Pace(10))
    wishes.pace.send()
    wishes.hear(Ack(number=1))
    assert wishes.changed.is_set()
    assert not wishes.restless
    wishes.hear(Keys(held=["left"]))
    assert wishes.restless
    assert wishes.pace.drawn == 1
