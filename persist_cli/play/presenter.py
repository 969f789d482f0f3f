"""Shows a page its walk: frames under the held actions, what its commands do."""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Awaitable, Callable
from typing import Final

from PIL import Image

from persist_cli.errors import PersistError
from persist_cli.play import messages
from persist_cli.play.messages import FrameHeader, ImagePart, Pose, ToPage, pack
from persist_cli.play.play import Play
from persist_cli.play.recordings import Shelf
from persist_cli.play.settings import Picture, Shown
from persist_cli.play.wishes import Wishes
from persist_cli.play.worker import Worker

Send = Callable[[ToPage | bytes], Awaitable[None]]
Frame = tuple[Shown, list[bytes]]  # and its images as PNG

PNG_EFFORT: Final = 1  # 0.2 ms and 5.5 kB for 64x64 pixels; WebP is a quarter smaller and takes twice as long, or more

KEYS: Final = {
    "forward": ["KeyW", "ArrowUp"],
    "backward": ["KeyS", "ArrowDown"],
    "left": ["KeyA", "ArrowLeft"],
    "right": ["KeyD", "ArrowRight"],
    "pick_up": ["KeyE"],
    "drop": ["KeyQ"],
    "toggle": ["KeyF"],
}  # of KeyboardEvent.code


def png(picture: Picture) -> bytes:
    """Return a picture as PNG."""
    file = io.BytesIO()
    Image.fromarray(picture.cpu().numpy()).save(file, "PNG", compress_level=PNG_EFFORT)
    return file.getvalue()


def encoded(shown: Shown | None) -> Frame | None:
    """Return a frame with its images as PNG, ``None`` without a frame."""
    return None if shown is None else (shown, [png(image) for image in shown.images.values()])


class Presenter:
    """Does what a page wishes with its walk, and sends what is to be seen.

    Args:
        play: the walk; it is touched in the worker only.
        wishes: what the page wants.
        worker: imagines and encodes.
        send: sends a message to the page.
        shelf: where recordings of this page lie.
    """

    def __init__(self, play: Play, wishes: Wishes, worker: Worker, send: Send, shelf: Shelf) -> None:
        self.play, self.wishes, self.worker, self.send, self.shelf = play, wishes, worker, send, shelf

    async def run(self) -> None:
        """Welcome the page, and serve it until this is cancelled."""
        await self.send(self._welcome())
        await self._show(await self.worker.run(lambda: encoded(self.play.shown)))
        while True:
            self.wishes.changed.clear()
            if not await self._serve():
                await self.wishes.wait(self._rest())

    async def _serve(self) -> bool:
        """Do the most urgent thing, and return whether there was one."""
        wishes = self.wishes
        if wishes.pace.is_open and wishes.commands:
            await self._obey(wishes.commands.popleft())
        elif wishes.pace.is_open and wishes.restless and not wishes.pace.wait:
            await self._advance()
        else:
            return False
        return True

    def _rest(self) -> float | None:
        """Seconds until something is due, ``None`` when nothing is before the page says something."""
        return self.wishes.pace.wait if self.wishes.restless and self.wishes.pace.is_open else None

    async def _advance(self) -> None:
        """Show the next frame under the held actions, if there is one."""
        self.wishes.restless = False  # unless the page says something meanwhile
        held = self.wishes.keys.take()
        try:
            frame = await self.worker.run(lambda: encoded(self.play.advance(held)))
        except PersistError as error:
            await self.send(messages.Error(text=str(error)))
            return
        if frame is not None:
            self.wishes.restless = True
            await self._show(frame)

    async def _obey(self, command: messages.Command) -> None:
        """Do a command, and say what has changed."""
        try:
            await self._show(await self.worker.run(lambda: encoded(self._do(command))))
        except PersistError as error:
            await self.send(messages.Error(text=str(error)))
        self.wishes.restless = True
        await self.send(self._state())

    def _do(self, command: messages.Command) -> Shown | None:
        """Do a command, and return the frame that it leads to, if any."""
        play = self.play
        match command:
            case messages.ChangeSettings():
                play.set(dataclasses.replace(play.settings, **command.changes))
            case messages.Reset():
                return play.reset(command.seed)
            case messages.Home():
                return play.home()
            case _:
                raise PersistError(f"this walk knows no {command.type!r} yet")
        return None

    async def _show(self, frame: Frame | None) -> None:
        """Send a frame, if there is one."""
        if frame is None:
            return
        (shown, images), pace = frame, self.wishes.pace
        header = FrameHeader(
            number=pace.send(), action=shown.action, free=shown.free, pose=Pose(**vars(shown.pose)),
            milliseconds=shown.milliseconds, frames_per_second=pace.rate,
            images=[ImagePart(memory=name, bytes=len(image)) for name, image in zip(shown.images, images, strict=True)],
        )  # fmt: skip
        await self.send(pack(header, images))

    def _welcome(self) -> messages.Welcome:
        height, width = next(iter(self.play.shown.images.values())).shape[:2]
        actions = [
            messages.ActionKeys(name=action.name, effect=action.effect, keys=KEYS.get(action.name, []))
            for action in self.play.actions
        ]
        return messages.Welcome(
            model=self.play.model, memories=list(self.play.memories), actions=actions, image=(width, height),
            settings=self._settings(), can=[],
            frames_per_second=self.wishes.pace.most,
        )  # fmt: skip

    def _settings(self) -> messages.Settings:
        now = self.play.settings
        return messages.Settings(steps=now.steps, guidance=now.guidance, seed=now.seed, ahead=now.ahead)

    def _state(self) -> messages.State:
        return messages.State(settings=self._settings())
