"""What a page wants: held actions, commands, and frames no faster than it draws them."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import deque
from collections.abc import Callable, Collection
from typing import Final

from persist_cli.errors import PersistError
from persist_cli.play.messages import MOST_UNDRAWN, Ack, ChangeSettings, Command, Keys, PageMessage, Undo

Clock = Callable[[], float]

MOST_COMMANDS: Final = 16  # that wait


class HeldActions:
    """The newest set of held actions; one that was let go before it could act still acts once."""

    def __init__(self) -> None:
        self.held: frozenset[str] = frozenset()
        self._pressed: list[str] = []  # since they last acted

    def hold(self, actions: Collection[str]) -> None:
        """Hold these actions and no others."""
        held = frozenset(actions)
        self._pressed += sorted(held - self.held - {*self._pressed})
        self.held = held

    def take(self) -> tuple[frozenset[str], frozenset[str]]:
        """Return the held actions of the next frame, and those newly pressed; of these at most one was let go again."""
        gone = [name for name in self._pressed if name not in self.held]
        pressed = frozenset(self._pressed) - frozenset(gone[1:])
        self._pressed = gone[1:]
        return self.held, pressed


class Pace:
    """Counts the frames that were sent and drawn, and says when the next one may be sent.

    Args:
        most: frames a second.
        clock: gives seconds.
    """

    def __init__(self, most: float, clock: Clock = time.monotonic) -> None:
        self.most, self.clock = most, clock
        self.sent = self.drawn = 0  # numbers of frames, which begin at 1
        self._due = 0.0

    @property
    def is_open(self) -> bool:
        """Whether the page has drawn enough of what it was sent for another frame."""
        return self.sent - self.drawn < MOST_UNDRAWN

    @property
    def wait(self) -> float:
        """Seconds until the next frame of a walk is due."""
        return max(0.0, self._due - self.clock())

    def send(self) -> int:
        """Count a frame that is sent now, and return its number."""
        now, between = self.clock(), 1 / self.most
        self.sent += 1
        self._due = max(self._due, now - between / 2) + between  # half a frame of delay is made up for, no more
        return self.sent

    def draw(self, number: int) -> None:
        """Note that the page has drawn the frame with a number, and so those before; other numbers change nothing."""
        self.drawn = max(self.drawn, min(number, self.sent))


class Allowance:
    """A number of messages that a page may send at once, which fills up again.

    Args:
        most: messages at once.
        rate: messages a second that come back.
        clock: gives seconds.
    """

    def __init__(self, most: float, rate: float, clock: Clock = time.monotonic) -> None:
        self.most, self.rate, self.clock = most, rate, clock
        self._left, self._last = most, clock()

    def spend(self) -> bool:
        """Return whether one more message is allowed, and count it."""
        now = self.clock()
        self._left = min(self.most, self._left + (now - self._last) * self.rate)
        self._last = now
        if self._left < 1:
            return False
        self._left -= 1
        return True


class Wishes:
    """What a page wants at present.

    Args:
        pace: counts the page's frames.
    """

    def __init__(self, pace: Pace) -> None:
        self.pace, self.keys = pace, HeldActions()
        self.commands: deque[Command] = deque()
        self.restless = False  # whether the next frame may differ from the last
        self.changed = asyncio.Event()

    def hear(self, message: PageMessage) -> None:
        """Take up a message. A command takes the place of one of its kind that waits, but for ``undo``.

        Raises:
            PersistError: when too many commands wait.
        """
        self.changed.set()
        match message:
            case Keys():
                self.keys.hold(message.held)
                self.restless = True
            case Ack():
                self.pace.draw(message.number)
            case _:
                self._queue(message)

    def _queue(self, command: Command) -> None:
        waiting = self.commands[-1] if self.commands else None
        if type(waiting) is type(command) and not isinstance(command, Undo):
            self.commands.pop()
            if isinstance(waiting, ChangeSettings) and isinstance(command, ChangeSettings):
                command = ChangeSettings(**(waiting.changes | command.changes))
        if len(self.commands) >= MOST_COMMANDS:
            raise PersistError(f"{MOST_COMMANDS} commands wait already; give them one by one")
        self.commands.append(command)

    async def wait(self, seconds: float | None) -> None:
        """Wait until the page says something, some seconds at most."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):  # wait_for of Python 3.11 can swallow that it is cancelled
                await self.changed.wait()
