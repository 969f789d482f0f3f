"""The part of the page that edits: it selects, does, takes back and saves what ``EditSession`` knows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, Protocol

import numpy as np
import viser

from persist_cli.api.cells import Box
from persist_cli.api.scene_edits import Point
from persist_cli.errors import DataError, PersistError
from persist_cli.viewer.camera_view import camera_of_view
from persist_cli.viewer.drawn_cells import cells_of_memory
from persist_cli.viewer.edit_session import EditSession
from persist_cli.viewer.notes import Note
from persist_cli.viewer.stage import Stage

NOTHING: Final = "nothing selected; draw a rectangle, or give a box"
CHOOSE: Final = "choose a thing"
HOLD: Final = ("the box", "what is in it")
PARTS: Final = ("after", "before", "changes")


class EditedPage(Protocol):
    """What the panel needs of the page that it is part of."""

    server: viser.ViserServer
    stage: Stage

    def guarded(self, work: Callable[[Any], None]) -> Callable[[Any], None]:
        """Return a callback that does some work alone, and shows an error that the user can mend."""

    def tell(self, text: str, event: Any, title: str = "") -> None:
        """Show a line in the tab where something happened."""

    def show_memory(self, part: str) -> None:
        """Draw the memory ``before`` the edits, ``after`` them, or the ``changes``."""

    def memory_changed(self) -> None:
        """Show what depends on what the memory holds now."""


class EditPanel:
    """The folders ``Select`` and ``Edit``.

    Args:
        page: the page that it is part of.
        session: what is edited.
    """

    def __init__(self, page: EditedPage, session: EditSession) -> None:
        self.page, self.session, self.gui = page, session, page.server.gui
        self._gizmo: Any = None
        self._armed: Any = None  # the callback that takes the next rectangle
        with self.gui.add_folder("Select"):
            self._add_selecting()
        with self.gui.add_folder("Edit"):
            self._add_editing()
        page.server.scene.on_rect_select(modifier="shift")(page.guarded(self._select_rectangle))
        self.show()

    def _add_selecting(self) -> None:
        gui, guarded = self.gui, self.page.guarded
        self._selected = Note(gui, NOTHING)
        once = gui.add_button("Rectangle", hint="Then draw it over the map. Or hold Shift and draw at any time.")
        once.on_click(guarded(lambda event: self._arm()))
        self._thing: Any = gui.add_dropdown("Thing", [CHOOSE], visible=False)
        self._thing.on_update(guarded(lambda event: self._select_thing(event.target.value)))
        low, high = self._extent()
        self._low: Any = gui.add_vector3("Box from", low, step=0.05)
        self._high: Any = gui.add_vector3("Box to", high, step=0.05)
        box = gui.add_button("Select this box")
        box.on_click(guarded(lambda event: self._select_box(self._low.value, self._high.value)))

    def _add_editing(self) -> None:
        gui = self.gui
        self._button("Remove", lambda: self.session.remove())
        self._color = gui.add_rgb("Colour", (230, 120, 30))
        self._button("Paint", lambda: self.session.paint(_color(self._color.value)))
        self._by = gui.add_vector3("By (m)", (0.5, 0.0, 0.0), step=0.05)
        self._overwrite = gui.add_checkbox("May replace things", False)
        self._button("Move", lambda: self._shift(copies=False))
        self._button("Copy", lambda: self._shift(copies=True))
        self._hold = gui.add_dropdown("The arrows move", HOLD)
        if self.session.kinds:
            self._kind = gui.add_dropdown("Class", self.session.kinds)
            self._button("Insert in the middle", lambda: self.session.insert(self._kind.value, None, self._over))
        undo = gui.add_button("Undo")
        undo.on_click(self.page.guarded(self._undo))
        self._part: Any = gui.add_dropdown("Show", PARTS)
        self._part.on_update(self.page.guarded(lambda event: self.page.show_memory(self._part.value)))
        self._state = Note(gui)
        save = gui.add_button("Save", color="green", hint=f"Writes {self.session.out}")
        save.on_click(self.page.guarded(self._save))

    def _button(self, label: str, work: Any) -> None:
        """Add a button for an edit."""

        def click(event: Any) -> None:
            work()
            self._done()

        self.gui.add_button(label).on_click(self.page.guarded(click))

    @property
    def _over(self) -> bool:
        return bool(self._overwrite.value)

    def _shift(self, copies: bool) -> None:
        self.session.shift(_point(self._by.value), copies, self._over)

    def _done(self) -> None:
        """Show the memory after what was done, which draws it once."""
        if self._part.value == PARTS[0]:
            self.page.show_memory(PARTS[0])
        self._part.value = PARTS[0]
        self.show()
        self.page.memory_changed()

    def _undo(self, event: Any) -> None:
        if not self.session.undo():
            return self.page.tell("there is no edit to take back", event, "Nothing to undo")
        return self._done()

    def _save(self, event: Any) -> None:
        try:
            memory, edits = self.session.save()
        except OSError as error:
            place = error.filename or self.session.out
            raise DataError(f"{place}: {error.strerror}; make room there, or give another --out") from error
        self.show()
        seed = f"; give `persist edit` --seed {self.session.seed} with them" if self.session.seed else ""
        self.page.tell(f"{memory} and its edits {edits.name}{seed}", event, "Saved")

    def _arm(self) -> None:
        """Take the next rectangle without a key, or no longer where that is so already."""
        scene, armed = self.page.server.scene, self._armed
        if armed is not None:
            self._armed = None
            return scene.remove_rect_select_callback(armed)

        def once(event: Any) -> None:
            self._arm()
            self._select_rectangle(event)

        self._armed = scene.on_rect_select()(self.page.guarded(once))
        return None

    def _select_rectangle(self, event: Any) -> None:
        view = camera_of_view(event.client)
        shown = self.page.stage.shown(cells_of_memory(self.session.edited))
        self.session.select_rectangle(view, event.screen_min, event.screen_max, shown)
        self.show()

    def _select_thing(self, name: str) -> None:
        if name != CHOOSE:
            self.session.select_thing(name)
            self.show()

    def _select_box(self, low: Any, high: Any) -> None:
        self.session.select_box(_point(low), _point(high))
        self.show()

    def show(self) -> None:
        """Show what is selected, the edits, and what became of them."""
        selection = self.session.selection
        boxes = [one.box for one in selection]
        self.page.stage.draw_boxes(boxes)
        names = ", ".join(one.name for one in selection if one.name)
        self._selected.say((names or f"a box of {_size(boxes[0])} m") if selection else NOTHING)
        if selection:
            self._low.value, self._high.value = boxes[0].low, boxes[0].high
        self._show_gizmo(boxes)
        things = [CHOOSE, *(thing.name for thing in self.session.things)]
        self._thing.visible = len(things) > 1
        if tuple(self._thing.options) != tuple(things):
            self._thing.options = things
        self._thing.value = CHOOSE  # so that the same one can be chosen again
        self._state.say(self._state_text())

    def _state_text(self) -> str:
        session, count = self.session, len(self.session.edits)
        if not count:
            return "the saved edits were undone, and the file still has them" if session.unsaved else "not edited"
        saved = "not saved" if session.unsaved else f"saved as {session.out.name}"
        last = session.edits[-1].edit
        return f"{count} edit{'s' * (count > 1)}, the last: {last}; {session.outcome.changed:,} cells changed; {saved}"

    def _show_gizmo(self, boxes: list[Box]) -> None:
        """Put arrows on the first selected box; they move it, or what is in it."""
        if self._gizmo is not None:
            self._gizmo.remove()
            self._gizmo = None
        if not boxes:
            return
        start = (np.array(boxes[0].low) + np.array(boxes[0].high)) / 2
        self._gizmo = self.page.server.scene.add_transform_controls(
            "/move", scale=0.5, position=start, disable_rotations=True, depth_test=False
        )
        dragged = self.page.guarded(lambda event: self._dragged(event.target, boxes[0], start))
        self._gizmo.on_update(lambda event: dragged(event) if event.phase == "end" else None)

    def _dragged(self, gizmo: Any, box: Box, start: np.ndarray[Any, Any]) -> None:
        """Move a box, or what is selected, as far as its arrows were dragged; those of an earlier box do nothing."""
        if gizmo is not self._gizmo:
            return
        by = _point(np.round(np.asarray(gizmo.position) - start, 2))
        if self._hold.value == HOLD[0]:
            ends = ([a + b for a, b in zip(end, by, strict=True)] for end in (box.low, box.high))
            return self._select_box(*ends)
        try:
            self.session.shift(by, False, self._over)
        except PersistError:
            self.show()  # the arrows go back
            raise
        return self._done()

    def _extent(self) -> tuple[Point, Point]:
        low, high = self.page.stage.bounds()
        ends = np.sort(np.stack([low, high]) @ self.page.stage.axes, axis=0).round(2)
        return _point(ends[0]), _point(ends[1])


def _point(values: Any) -> Point:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _color(values: Any) -> tuple[int, int, int]:
    red, green, blue = (int(value) for value in values)
    return red, green, blue


def _size(box: Box) -> str:
    return " × ".join(f"{high - low:.2f}" for low, high in zip(box.low, box.high, strict=True))
