"""The panel of the page and what its buttons do; the state lies in ``EditSession`` and ``Stage``."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, Final

import numpy as np
import viser
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.cells import CellOrigin
from persist_cli.api.memory import Memory
from persist_cli.errors import PersistError
from persist_cli.viewer.camera_view import camera_of_view
from persist_cli.viewer.drawn_cells import ORIGIN_COLORS, cells_of_memory, class_colors
from persist_cli.viewer.edit_panel import EditPanel
from persist_cli.viewer.edit_session import EditSession
from persist_cli.viewer.imagine import Imaginer
from persist_cli.viewer.imagine_panel import ImaginePanel
from persist_cli.viewer.notes import Legend, Note, Pictures, error_line
from persist_cli.viewer.stage import CHANGED, REMOVED, SAME, Look, Stage
from persist_cli.viewer.subject import DrawnWalk, Subject

TOKENS: Final = 256  # that a reading draws when nobody says how many
MOST_TOKENS: Final = 4096
FRAMES_A_SECOND: Final = 6.0
NEARER: Final = 0.5  # metres that the view must have moved until large maps are drawn anew around it
QUIET: Final = 0.5  # seconds at least between two of these drawings
FAULT: Final = "a fault of persist; the terminal says more"
COLORINGS: Final = {"own colour": "color", "origin": "origin", "class": "class"}


class Page:
    """Everything on the page. All tabs that show it share it.

    Args:
        server: its server.
        subject: what is shown.
        look: how it is drawn at first.
        session: the edits; ``None`` where there is no memory.
        imaginer: the world model; ``None`` where no true frame is known from which it could begin.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        subject: Subject,
        look: Look,
        session: EditSession | None,
        imaginer: Imaginer | None,
    ) -> None:
        self.server, self.subject, self.look = server, subject, look
        self.session = session
        self.lock = threading.RLock()  # viser calls back in many threads
        self.stage = Stage(server, subject, look)
        self.focus: np.ndarray[Any, Any] | None = None
        self._viewed_from, self._drawn_at = np.zeros(3), 0.0
        self._is_coarse, self._comes_near = False, False  # whether blocks stand for several cells; whether more come
        self._plays = False
        self._ends = False
        self.edit_panel: EditPanel | None = None
        self.imagine_panel: ImaginePanel | None = None
        tabs = server.gui.add_tab_group()
        with tabs.add_tab("Look"):
            self._add_map_panel()
            if subject.walks:
                self._add_time_panel()
        if session is not None:
            with tabs.add_tab("Edit"):
                self.edit_panel = EditPanel(self, session)
            with tabs.add_tab("Reading"):
                self._add_reading_panel()
        if imaginer is not None:
            with tabs.add_tab("Imagine"):
                self.imagine_panel = ImaginePanel(self, imaginer)
        server.on_client_connect(self._follow_view)

    # what every button does around its work

    def guarded(self, work: Callable[[Any], None]) -> Callable[[Any], None]:
        """Return a callback that does some work alone, and shows an error that the user can mend."""

        def callback(event: Any) -> None:
            with self.lock:
                try:
                    if not self._ends:
                        work(event)
                except (PersistError, OSError) as error:
                    self.tell(error_line(error), event)
                except BaseException:
                    self.tell(FAULT, event)
                    raise

        return callback

    def end(self) -> None:
        """Finish what is being done, and keep the lock, so that nothing changes any more."""
        self._ends = True
        self.lock.acquire()

    def newest(self, work: Callable[[Any], None]) -> Callable[[Any], None]:
        """Return a callback as ``guarded`` does, which works once for all events that wait for their turn.

        The work must look at what holds now. So a slider that is dragged over a large map does not draw every step.
        """
        waits = threading.Event()

        def once(event: Any) -> None:
            if waits.is_set():
                waits.clear()
                work(event)

        guarded = self.guarded(once)

        def callback(event: Any) -> None:
            waits.set()
            guarded(event)

        return callback

    def tell(self, text: str, event: Any, title: str = "That did not work") -> None:
        """Show a line in the tab where something happened, if it is still open, or in all tabs."""
        asked = getattr(event, "client", None)
        for client in self.server.get_clients().values():
            if asked is None or client is asked:
                client.add_notification(title, text, auto_close_seconds=12.0)

    # the map

    def _add_map_panel(self) -> None:
        gui, look = self.server.gui, self.look
        with gui.add_folder("Map"):
            for name in self.stage.layers:
                box = gui.add_checkbox(name, name in look.layers)
                box.on_update(self.newest(partial(self._toggle, name)))
            named = any(cells.palette for cells in self.stage.layers.values())
            colors = gui.add_dropdown("Colour", [text for text in COLORINGS if named or text != "class"])
            colors.on_update(self.newest(lambda event: self._set(colors=COLORINGS[event.target.value])))
            form = gui.add_dropdown("Draw as", ["cubes", "points"], initial_value=look.form)
            form.on_update(self.newest(lambda event: self._set(form=event.target.value)))
            self._add_cut()
            if len(self.stage.layers) > 1:
                beside = gui.add_checkbox("Truth beside", look.beside)
                beside.on_update(self.newest(lambda event: self._set(beside=event.target.value)))
            self._legend, self._drawn_text = Legend(gui), Note(gui)
        self._say_drawn()

    def _add_cut(self) -> None:
        low, high = (float(end[2]) for end in self.stage.bounds())
        if high - low < 0.1:
            return
        first = min(max(self.look.cut, low), high)
        cut = self.server.gui.add_slider(
            "Cut at (m)", round(low, 2), round(high + 0.1, 2), 0.05, round(first, 2),
            hint="Height above which nothing is drawn, so that one looks into rooms.",
        )  # fmt: skip
        cut.on_update(self.newest(lambda event: self._set(cut=event.target.value)))

    def _toggle(self, layer: str, event: Any) -> None:
        (self.look.layers.add if event.target.value else self.look.layers.discard)(layer)
        self.draw()

    def _set(self, **changes: Any) -> None:
        for name, value in changes.items():
            setattr(self.look, name, value)
        self.draw()

    def draw(self) -> None:
        """Draw the layers anew, and say how much of them is drawn."""
        self.stage.draw(self.focus)
        self._drawn_at = time.monotonic()
        self._say_drawn()

    @property
    def memory(self) -> Memory | None:
        """The memory as it is edited now, ``None`` without one."""
        return None if self.session is None else self.session.edited

    def memory_changed(self) -> None:
        """Let the camera that is placed, if one is, show what the model imagines with the memory as it is now."""
        if self.imagine_panel is not None:
            self.imagine_panel.renew()

    def show_memory(self, part: str) -> None:
        """Draw the memory ``before`` the edits, ``after`` them, or the ``changes``."""
        assert self.session is not None
        original, edited = self.session.original, self.session.edited
        if part == "changes":
            self.stage.set_changes(cells_of_memory(original), cells_of_memory(edited))
        else:
            self.stage.set_map(cells_of_memory(edited if part == "after" else original))
        self.draw()

    def _say_drawn(self) -> None:
        lines = [
            f"{name}: {blocks:,} blocks" + (f" stand for {cells:,} cells" if blocks < cells else "")
            for name, (blocks, cells) in self.stage.drawn.items()
        ]
        self._is_coarse = any(blocks < cells for blocks, cells in self.stage.drawn.values())
        if self._is_coarse:
            lines.append("Come nearer for smaller blocks; --most allows more of them.")
        self._drawn_text.say(*self.subject.notices, *lines)
        self._legend.show(self._meanings())

    def _meanings(self) -> list[tuple[str, Any]]:
        """Return what the present colours mean."""
        if self.stage.shows_changes:
            return [("changed or new", CHANGED), ("taken away", REMOVED), ("as before", SAME)]
        if self.look.colors == "origin":
            return [(CellOrigin(origin).name.lower(), color) for origin, color in ORIGIN_COLORS.items()]
        kinds: dict[str, Any] = {}
        if self.look.colors == "class":
            for name in self.look.layers:
                cells = self.stage.layers[name]
                table = class_colors(len(cells.palette))
                kinds |= {cells.palette[n]: table[n] for n in np.unique(cells.kinds) if n < len(cells.palette)}
        return list(kinds.items())

    def _follow_view(self, client: viser.ClientHandle) -> None:
        client.camera.on_update(lambda camera: self._on_moved(np.asarray(camera.position)))

    def _on_moved(self, position: np.ndarray[Any, Any]) -> None:
        """Draw maps that are too large for single cells in more detail near the view, soon and at most twice a second.

        Of the places in between the last one counts.
        """
        self._viewed_from = position
        if self._is_coarse and not self._comes_near:
            self._comes_near = True
            timer = threading.Timer(max(0.0, self._drawn_at + QUIET - time.monotonic()), self._draw_near)
            timer.daemon = True
            timer.start()

    def _draw_near(self) -> None:
        with self.lock:
            self._comes_near = False
            position = self._viewed_from
            if self._is_coarse and (self.focus is None or float(np.linalg.norm(position - self.focus)) > NEARER):
                self.focus = position
                self.draw()

    # time

    def _add_time_panel(self) -> None:
        gui, length = self.server.gui, max(map(len, self.subject.walks))
        with gui.add_folder("Time"):
            self.frame: Any = gui.add_slider("Frame", 0, max(length - 1, 1), 1, 0)
            self.frame.on_update(self.newest(lambda event: self._show_frame()))
            if length > 1:
                self.play = gui.add_checkbox("Play", False)
                self.play.on_update(lambda event: self._play(event.target))
            self._pictures = Pictures(gui)
        self._show_frame()

    def _show_frame(self) -> None:
        frame = int(self.frame.value)
        self.stage.draw_time(frame)
        self._pictures.show(_pictures(self.subject.walks, frame))

    def _play(self, box: Any) -> None:
        """Go on frame by frame until the box is no longer checked or nobody looks."""
        last = int(self.frame.max)
        with self.lock:
            if self._plays:  # the loop of an earlier press goes on
                return
            self._plays = True
        try:
            while box.value and self.server.get_clients():
                with self.lock:
                    self.frame.value = 0 if self.frame.value >= last else int(self.frame.value) + 1  # draws it
                time.sleep(1 / FRAMES_A_SECOND)
        finally:
            with self.lock:
                box.value = False  # also when nobody looks any more
                self._plays = False

    def present_camera(self) -> Cameras | None:
        """Return the camera of the first walk at the present frame, with a frame axis of one; ``None`` without one."""
        if not self.subject.walks:
            return None
        walk = self.subject.walks[0]
        frame = min(int(self.frame.value), len(walk) - 1)
        return walk.cameras[frame : frame + 1]

    # what a camera reads

    def _add_reading_panel(self) -> None:
        gui = self.server.gui
        self._read_text = Note(gui, "What the memory tells a camera: its tokens, drawn in yellow.")
        self._budget = gui.add_slider("Most tokens", 1, MOST_TOKENS, 1, TOKENS)
        if self.subject.walks:
            here = gui.add_button("Read at this frame")
            here.on_click(self.guarded(lambda event: self._read(self.present_camera())))
        view = gui.add_button("Read from this view")
        view.on_click(self.guarded(lambda event: self._read(camera_of_view(event.client))))
        clear = gui.add_button("Clear")
        clear.on_click(self.guarded(lambda event: self.stage.draw_tokens(None)))

    def _read(self, camera: Cameras | None) -> None:
        assert self.session is not None
        if camera is None:
            return
        [tokens] = self.session.edited.recall([camera], int(self._budget.value))
        self.stage.draw_tokens(tokens)
        imagined = int((tokens.origins == CellOrigin.IMAGINED).sum())
        self._read_text.say(f"{len(tokens):,} tokens, {imagined:,} of them imagined, {tokens.bytes:,} bytes")


def _pictures(walks: Sequence[DrawnWalk], frame: int) -> Iterator[tuple[str, Tensor]]:
    """Yield the pictures of walks at a frame, or at their last one, with their names."""
    for walk in walks:
        number = min(frame, len(walk) - 1)
        if walk.pictures is not None:
            yield f"{walk.name}, frame {walk.numbers[number]}", walk.pictures[number]
