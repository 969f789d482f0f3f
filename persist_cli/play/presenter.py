"""Shows a page its walk: frames under the held actions, what its commands do, and the map."""

from __future__ import annotations

import dataclasses
import io
import time
from collections.abc import Awaitable, Callable
from typing import Final

from PIL import Image

from persist_cli.errors import PersistError
from persist_cli.play import messages
from persist_cli.play.messages import FrameHeader, ImagePart, MapHeader, Pose, ToPage, pack
from persist_cli.play.play import Play
from persist_cli.play.recording import LONGEST
from persist_cli.play.recordings import Shelf
from persist_cli.play.settings import Picture, Shown
from persist_cli.play.wishes import Wishes
from persist_cli.play.worker import Workers

Send = Callable[[ToPage | bytes], Awaitable[None]]
Frame = tuple[Shown, list[bytes]]  # and its images as PNG

MAP_SECONDS: Final = 0.5  # at least, from one map to the next
MAP_SHARE: Final = 0.03  # of the time, at most, that goes into maps
MAP_SIZE: Final = 320  # pixels of its longer side
THINK_SECONDS: Final = 0.01  # after which no other clip is begun ahead, so that a key waits for one at most
BUSY_SECONDS: Final = 0.2  # after which it is asked again whether nobody walks, so that there is time to think
PNG_EFFORT: Final = 1  # 0.2 ms and 5.5 kB for 64x64 pixels; WebP is a quarter smaller and takes twice as long, or more

PLANNER_ENDED: Final = "the planner has ended: nothing near looks more like the goal, or it has looked for long enough"

RECORDING_FULL: Final = f"the recording is full, with {LONGEST:,} frames; it is saved now, and you can begin another"

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
        play: the walk; all that takes time is done with it in the worker.
        wishes: what the page wants.
        workers: imagine, encode and save.
        send: sends a message to the page.
        shelf: where recordings of this page lie.
    """

    def __init__(self, play: Play, wishes: Wishes, workers: Workers, send: Send, shelf: Shelf) -> None:
        self.play, self.wishes, self.send, self.shelf = play, wishes, send, shelf
        self.worker, self.saver = workers.model, workers.saver
        self.may_think: Callable[[], bool] = lambda: not wishes.restless  # the worker is for those who walk first
        self._map_is_old, self._map_due = True, 0.0
        self._thinks = True  # whether something may be left to imagine ahead
        self._told: messages.State | None = None
        self._was_full = False

    async def run(self) -> None:
        """Welcome the page, and serve it until this is cancelled."""
        self._told = self._state()
        await self.send(self._welcome())
        for notice in self.play.notices:
            await self.send(messages.Notice(text=notice))
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
        elif self._map_is_old and time.monotonic() >= self._map_due:
            await self._show_map()
        elif self._thinks and self.may_think():
            self._thinks = await self.worker.run(lambda: self.play.think(THINK_SECONDS))
        else:
            return False
        return True

    def _rest(self) -> float | None:
        """Seconds until something is due, ``None`` when nothing is before the page says something."""
        due = []
        if self.wishes.restless and self.wishes.pace.is_open:
            due.append(self.wishes.pace.wait)
        if self._map_is_old:
            due.append(max(0.0, self._map_due - time.monotonic()))
        if self._thinks:
            due.append(BUSY_SECONDS)
        return min(due, default=None)

    async def _advance(self) -> None:
        """Show the next frame under the held actions or of the planner, if there is one."""
        (held, pressed), planned = self.wishes.keys.take(), self.play.planning
        self.wishes.restless = bool(pressed - held)  # a tap acts alone; else unless the page says something meanwhile
        try:
            frame = await self.worker.run(lambda: encoded(self.play.advance(held, pressed)))
        except PersistError as error:
            self.play.stop()  # or the planner would fail again and again
            await self.send(messages.Error(text=str(error)))
            frame = None
        if planned and not held | pressed and not self.play.planning:
            await self.send(messages.Notice(text=PLANNER_ENDED))
        if frame is not None:
            self.wishes.restless = True
            await self._show(frame)
            await self._save_full()
        elif self.play.planning:
            self.wishes.restless = True  # the planner decides in parts, between which others take their turns
        else:
            self._map_is_old = True  # what was shown last is remembered only now
        await self._tell_changes()

    async def _obey(self, command: messages.Command) -> None:
        """Do a command, and say what has changed."""
        try:
            if isinstance(command, messages.Record) and not command.on:
                await self._save()
            else:
                frame = await self.worker.run(lambda: encoded(self._do(command)))
                if isinstance(command, messages.Undo) and frame is None:
                    await self.send(messages.Notice(text="nothing is left to undo"))
                await self._show(frame)
        except PersistError as error:
            await self.send(messages.Error(text=str(error)))
        await self._save_full()
        self.wishes.restless = self._thinks = True
        await self._tell_changes(anyway=True)

    async def _save(self) -> None:
        """Save the recording; this page waits, and the others go on."""
        await self.send(await self.saver.run(lambda: self.shelf.save(self.play)))

    async def _save_full(self) -> None:
        """Save a recording that has become full, once; where that fails it stays until the page ends it."""
        if self.play.recording_is_full and not self._was_full:
            await self.send(messages.Notice(text=RECORDING_FULL))
            try:
                await self._save()
            except PersistError as error:
                await self.send(messages.Error(text=str(error)))
        self._was_full = self.play.recording_is_full

    def _do(self, command: messages.Command) -> Shown | None:
        """Do a command, and return the frame that it leads to, if any."""
        play = self.play
        match command:
            case messages.ChangeSettings():
                play.set(dataclasses.replace(play.settings, **command.changes))
            case messages.Reset():
                return play.reset(command.seed)
            case messages.Undo():
                return play.undo()
            case messages.Home():
                return play.home()
            case messages.Jump():
                return play.jump(command.x, command.y)
            case messages.Record():
                play.record()
            case messages.Goal():
                play.take_goal()
            case messages.Plan():
                play.plan()
            case messages.Stop():
                play.stop()
        return None

    async def _show(self, frame: Frame | None) -> None:
        """Send a frame, if there is one; the map is old then."""
        if frame is None:
            return
        (shown, images), pace = frame, self.wishes.pace
        header = FrameHeader(
            number=pace.send(), action=shown.action, free=shown.free, pose=Pose(**vars(shown.pose)),
            milliseconds=shown.milliseconds,
            images=[ImagePart(memory=name, bytes=len(image)) for name, image in zip(shown.images, images, strict=True)],
        )  # fmt: skip
        self._map_is_old = self._thinks = True
        await self.send(pack(header, images))

    async def _show_map(self) -> None:
        """Send the map from above. A large one comes less often, so that most of the time is left for frames."""
        self._map_is_old, begun = False, time.monotonic()
        image, extent = await self.worker.run(self._draw_map)
        now = time.monotonic()
        self._map_due = now + max(MAP_SECONDS, (now - begun) / MAP_SHARE)
        part = ImagePart(memory=self.play.memories[0], bytes=len(image))
        await self.send(pack(MapHeader(extent=extent, images=[part]), [image]))

    def _draw_map(self) -> tuple[bytes, tuple[float, float, float, float]]:
        drawn = self.play.map(MAP_SIZE)
        return png(drawn.picture), drawn.extent

    async def _tell_changes(self, anyway: bool = False) -> None:
        """Tell what has changed beside the picture; ``anyway``: also when nothing has."""
        state = self._state()
        if anyway or state != self._told:
            self._told = state
            await self.send(state)

    def _welcome(self) -> messages.Welcome:
        height, width = next(iter(self.play.shown.images.values())).shape[:2]
        actions = [
            messages.ActionKeys(name=action.name, effect=action.effect, keys=KEYS.get(action.name, []))
            for action in self.play.actions
        ]
        return messages.Welcome(
            model=self.play.model, memories=list(self.play.memories), actions=actions, image=(width, height),
            settings=self._settings(), limits=messages.limits(self.play.takes_autoguidance),
        )  # fmt: skip

    def _settings(self) -> messages.Settings:
        now = self.play.settings
        return messages.Settings(
            steps=now.steps, guidance=now.guidance, autoguidance=now.autoguidance, seed=now.seed, ahead=now.ahead
        )

    def _state(self) -> messages.State:
        play = self.play
        return messages.State(
            settings=self._settings(), recording=play.recording, goal=play.goal is not None, planning=play.planning
        )
