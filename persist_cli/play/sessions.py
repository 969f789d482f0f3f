"""Sessions of ``persist play``: each is one WebSocket of a page, and its own walk."""

from __future__ import annotations

import asyncio
import sys
import traceback
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketDisconnected

from persist_cli.errors import PersistError
from persist_cli.play import messages
from persist_cli.play.messages import ToPage, read_message
from persist_cli.play.play import Play
from persist_cli.play.presenter import Presenter
from persist_cli.play.recordings import Recordings
from persist_cli.play.wishes import Allowance, Pace, Wishes
from persist_cli.play.worker import Workers

GOING_AWAY: Final = 1001
NOT_ALLOWED: Final = 1008
FAULT: Final = 1011
TRY_LATER: Final = 1013

MESSAGES: Final = (200.0, 100.0)  # of a page: at once, and a second, beside one for each frame that it draws
WRONG: Final = (20.0, 0.1)  # of these, that cannot be read
SEND_SECONDS: Final = 30.0  # in which a page takes a message, or is given up
RELOAD_SECONDS: Final = 1.0  # in which a session may end for one that wants to begin
CLOSE_SECONDS: Final = 1.0  # in which it takes the last one


class SessionEndError(Exception):
    """Ends a session: a line for its page, and a close code of its WebSocket."""

    def __init__(self, text: str, code: int) -> None:
        super().__init__(text)
        self.code = code


@dataclass(frozen=True)
class Limits:
    """What sessions may take.

    Args:
        sessions: most at once.
        frames_per_second: most that one gets.
    """

    sessions: int = 4
    frames_per_second: float = 15.0


class Sessions:
    """All sessions of a server.

    Args:
        open_play: makes the walk of a new session; called where the model works.
        limits: what sessions may take.
        recordings: where they save.
    """

    def __init__(self, open_play: Callable[[], Play], limits: Limits, recordings: Recordings) -> None:
        self.open_play, self.limits, self.recordings = open_play, limits, recordings
        self.workers = Workers()
        self.open: set[Session] = set()
        self.ending: set[Session] = set()  # what they recorded may still be saved
        self._closing = False

    async def serve(self, socket: WebSocket) -> None:
        """Let a page walk until it goes, its session fails, or the server stops; refuse it when all are taken."""
        session = Session(socket, self)
        if not await self._has_room():
            taken = f"all {self.limits.sessions} sessions are taken; close another tab, or start with more --sessions"
            session.end(SessionEndError(taken, TRY_LATER))
        else:
            self.open.add(session)
        try:
            await session.run()
        finally:
            self.open.discard(session)

    @property
    def somebody_walks(self) -> bool:
        """Whether some page waits for its next frame."""
        return any(session.wishes.restless and session.wishes.pace.is_open for session in self.open)

    @property
    def unsaved(self) -> bool:
        """Whether a session that has ended recorded something that is to stay and is not saved yet."""
        return self.recordings.stays and any(session.records for session in list(self.ending))

    async def _has_room(self) -> bool:
        """Return whether another session may begin; a tab that is loaded again waits for its old one to end."""
        if len(self.open) >= self.limits.sessions:
            over = [session.over for session in self.open]
            await asyncio.wait(over, timeout=RELOAD_SECONDS, return_when=asyncio.FIRST_COMPLETED)
        return not self._closing and len(self.open) < self.limits.sessions

    async def close(self) -> None:
        """End all sessions, and wait a moment until their pages know."""
        self._closing = True
        ended = [session.end(SessionEndError("the server was stopped", GOING_AWAY)) for session in self.open]
        if ended:
            await asyncio.wait(ended, timeout=CLOSE_SECONDS)


class Session:
    """One page's walk. The event loop hears the page and sends what it shall see; workers imagine and save."""

    def __init__(self, socket: WebSocket, sessions: Sessions) -> None:
        self.socket, self.sessions, self.workers = socket, sessions, sessions.workers
        self.wishes = Wishes(Pace(sessions.limits.frames_per_second))
        self.shelf = sessions.recordings.shelf()
        self._play: Play | None = None
        most, rate = MESSAGES
        self._allowance = Allowance(most, rate + sessions.limits.frames_per_second)
        self._wrong = Allowance(*WRONG)
        loop = asyncio.get_running_loop()
        self._stopped: asyncio.Future[None] = loop.create_future()
        self.over: asyncio.Future[None] = loop.create_future()

    def end(self, reason: SessionEndError) -> asyncio.Future[None]:
        """Let the session end for a reason, and return what is done when it has ended."""
        if not self._stopped.done():
            self._stopped.set_exception(reason)
        return self.over

    async def run(self) -> None:
        """Serve the page until something ends the session; what ends it stays in it."""
        parts: list[asyncio.Future[None]] = [self._stopped]
        try:
            await self.socket.accept()
            if not self._stopped.done():
                parts += map(asyncio.ensure_future, (self._listen(), self._walk()))
            done, _ = await asyncio.wait(parts, return_when=asyncio.FIRST_COMPLETED)
            await self._say_why(part.exception() for part in done)
        finally:
            for part in parts:
                part.cancel()
            await asyncio.gather(*parts, return_exceptions=True)
            self.sessions.ending.add(self)
            self.workers.give_last(self._clear)  # after what is under way
            self.over.set_result(None)

    @property
    def records(self) -> bool:
        """Whether there is a recording, which is not saved yet."""
        return self._play is not None and self._play.recording

    def _clear(self) -> None:
        try:
            self.shelf.clear(self._play)
        finally:
            self.sessions.ending.discard(self)

    async def _walk(self) -> None:
        self._play = await self.workers.model.run(self.sessions.open_play)
        presenter = Presenter(self._play, self.wishes, self.workers, self._send, self.shelf)
        presenter.may_think = lambda: not self.sessions.somebody_walks
        await presenter.run()

    async def _listen(self) -> None:
        """Take up what the page sends until it goes."""
        while (message := await self.socket.receive())["type"] != "websocket.disconnect":
            if not self._allowance.spend():
                raise SessionEndError("the page sends too many messages; reload it", NOT_ALLOWED)
            try:
                self._hear(message)
            except PersistError as error:
                await self._send(messages.Error(text=str(error)))

    def _hear(self, message: Mapping[str, Any]) -> None:
        """Take up a message; too many that cannot be read end the session."""
        try:
            text = message.get("text")
            if text is None:
                raise PersistError("cannot read binary messages; the page sends JSON text")
            said = read_message(text)
        except PersistError as error:
            if not self._wrong.spend():
                raise SessionEndError("too many messages could not be read; reload the page", NOT_ALLOWED) from error
            raise
        self.wishes.hear(said)

    async def _send(self, message: ToPage | bytes) -> None:
        try:
            async with asyncio.timeout(SEND_SECONDS):
                if isinstance(message, bytes):
                    await self.socket.send_bytes(message)
                else:
                    await self.socket.send_text(message.to_json())
        except (TimeoutError, RuntimeError) as error:  # uvicorn raises the latter when it closed the socket itself
            raise WebSocketDisconnect(GOING_AWAY) from error

    async def _say_why(self, errors: Iterable[BaseException | None]) -> None:
        """Tell the page why its session ends, if it is still there."""
        error = next(filter(None, errors), None)
        if error is None or isinstance(error, WebSocketDisconnect | WebSocketDisconnected):
            return
        text, code = str(error), error.code if isinstance(error, SessionEndError) else FAULT
        if not isinstance(error, SessionEndError | PersistError):
            traceback.print_exception(error, file=sys.stderr)
            name = type(error).__name__
            text = f"this session failed by a fault of persist, {name}; the terminal says more; reload to begin again"
        try:
            async with asyncio.timeout(CLOSE_SECONDS):
                await self.socket.send_text(messages.Error(text=one_line(text), ended=True).to_json())
                await self.socket.close(code)
        except (WebSocketDisconnect, WebSocketDisconnected, TimeoutError, RuntimeError):
            return


def one_line(text: str) -> str:
    """Return a text in one line of at most 300 letters."""
    line = " ".join(text.split())
    return line if len(line) <= 300 else f"{line[:299]}…"
