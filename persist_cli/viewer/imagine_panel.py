"""The part of the page that imagines: a camera that is placed by hand, and what the model sees there."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import closing
from typing import Any, Final, Protocol

import numpy as np
import viser
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.memory import Memory
from persist_cli.errors import PersistError
from persist_cli.viewer.camera_view import camera_of_view, pose_of, world_from
from persist_cli.viewer.imagine import ImaginedView, Imaginer
from persist_cli.viewer.notes import Note, Pictures, error_line
from persist_cli.viewer.stage import FULL_SIZE, SELECTED_COLOR, Stage

IMAGINING: Final = "imagining …"
LOADING: Final = "imagining … as soon as the model is loaded"
FAULT: Final = "that failed, and the terminal says why; move the camera to try again"


class ImaginingPage(Protocol):
    """What the panel needs of the page that it is part of."""

    server: viser.ViserServer
    stage: Stage
    lock: threading.RLock

    @property
    def memory(self) -> Memory | None:
        """The memory as it is edited now, ``None`` without one."""

    def guarded(self, work: Callable[[Any], None]) -> Callable[[Any], None]:
        """Return a callback that does some work alone, and shows an error that the user can mend."""

    def tell(self, text: str, event: Any, title: str = "") -> None:
        """Show a line in the tab where something happened."""

    def present_camera(self) -> Cameras | None:
        """Return the camera of the present frame, with a frame axis of one; ``None`` without one."""


class ImaginePanel:
    """The tab ``Imagine``.

    Args:
        page: the page that it is part of.
        imaginer: the world model.
    """

    def __init__(self, page: ImaginingPage, imaginer: Imaginer) -> None:
        self.page, self.imaginer = page, imaginer
        self._lens = imaginer.start.cameras([0])
        self._camera: Any = None  # the gizmo of the camera that is placed
        self._wanted, self._works, self._loads = False, False, False
        gui, guarded = page.server.gui, page.guarded
        Note(gui, "A camera that you place shows what the world model imagines there. Move it, and it imagines anew.")
        if page.present_camera() is not None:
            here = gui.add_button("Camera at this frame")
            here.on_click(guarded(lambda event: self.place(page.present_camera(), event)))
        view = gui.add_button("Camera at this view")
        view.on_click(guarded(lambda event: self.place(camera_of_view(event.client), event)))
        away = gui.add_button("Take the camera away")
        away.on_click(guarded(lambda event: self.remove()))
        self.text, self.pictures = Note(gui), Pictures(gui)

    def place(self, camera: Cameras | None, event: Any = None) -> None:
        """Place a camera that can be moved by its arrows and rings, and imagine what it sees.

        Args:
            camera: where, with a frame axis of one.
            event: what happened in which tab.
        """
        if camera is None:
            return
        wxyz, position = pose_of(camera.world_from_camera[0])
        self._camera = self.page.server.scene.add_transform_controls(
            "/placed", scale=0.6, wxyz=wxyz, position=position, depth_test=False
        )
        self._camera.on_update(lambda moved: self.renew(moved) if moved.phase == "end" else None)
        self._draw(None)
        self.renew(event)

    def remove(self) -> None:
        """Take the camera away, and what was said of it."""
        if self._camera is not None:
            self._camera.remove()
            self._camera = None
        self.text.say()
        self.pictures.show([])

    def renew(self, event: Any = None) -> None:
        """Imagine anew at the camera, if one is placed, in a thread; what is imagined now ends with its clip."""
        with self.page.lock:
            self._wanted = self._camera is not None
            if self._wanted and not self._works:
                self._works = True
                threading.Thread(target=self._work, args=(event,), daemon=True).start()  # viser's own delay the exit

    def load_ahead(self, _: Any = None) -> None:
        """Begin to load the model, once, so that the first camera need not wait for it."""
        with self.page.lock:
            begins, self._loads = not self._loads, True
        if begins:
            threading.Thread(target=self._load, daemon=True).start()

    def _load(self) -> None:
        try:
            self.imaginer.load(self.page.memory)
        except (PersistError, OSError) as error:
            with self.page.lock:
                if not self._works:
                    self.text.say(error_line(error))

    def _work(self, event: Any) -> None:
        """Imagine one view, and begin the next one if the camera was moved meanwhile."""
        with self.page.lock:
            self._wanted = False
            if self._camera is None:  # taken away before this began
                self._works = False
                return
            pose, memory = world_from(self._camera.wxyz, self._camera.position), self.page.memory
            self.text.say(IMAGINING if self.imaginer.loaded else LOADING)
        try:
            self._imagine(pose, memory)
        except (PersistError, OSError) as error:
            with self.page.lock:
                self.text.say(error_line(error))
            self.page.tell(error_line(error), event)
        finally:
            with self.page.lock:
                self._works = False
                if self._wanted:
                    self.renew(event)
                elif self.text.text.startswith(IMAGINING):  # nothing took its place
                    self.text.say(FAULT)

    def _imagine(self, pose: Tensor, memory: Memory | None) -> None:
        """Show the way to a pose as it is imagined, until the camera is moved or taken away."""
        began = time.monotonic()
        with closing(self.imaginer.imagine(pose, memory)) as views:
            for view in views:
                with self.page.lock:
                    if self._wanted or self._camera is None:
                        return
                    self._show(view, 1000 * (time.monotonic() - began))

    def _show(self, view: ImaginedView, milliseconds: float) -> None:
        way = f"{view.frames} frames on from frame {view.began} of {self.imaginer.start.name}"
        if view.arrived:
            self._draw(view.picture.numpy())
            self.text.say(f"{way}, {milliseconds:,.0f} ms")
        elif view.frames:
            self.text.say(f"{IMAGINING} {way}")
        name = "imagined" if view.frames else f"true frame {view.began}, where it begins"
        self.pictures.show([(name, view.picture)])

    def _draw(self, picture: np.ndarray[Any, Any] | None) -> None:
        identity = self._lens.at(world_from(np.array([1.0, 0, 0, 0]), np.zeros(3))[None])
        self.page.stage.draw_frustum("/placed/camera", identity, picture, FULL_SIZE, SELECTED_COLOR)
