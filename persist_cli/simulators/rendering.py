"""Rendering of houses with OpenGL, off screen: colour with four samples a pixel, depth at the pixel's centre.

MiniWorld's own frame buffer keeps depth in 16 bits and takes it from one of the samples, off the pixel's
centre; at 64×64 pixels both cost centimetres. Here depth has 32 bits and its own pass.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib.util
import math
import os
import warnings
from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from persist_cli.errors import PluginError
from persist_cli.simulators.houses import House, Thing
from persist_cli.simulators.meshes import Mesh, MeshPart, read_mesh
from persist_cli.simulators.panels import Panel, furniture_panels, house_panels

NEAR, FAR = 0.04, 100.0  # metres
SKY = 99.0  # metres; depth beyond is stored as missing
SKY_COLOUR = (0.25, 0.82, 1.0)
SAMPLES = 4
LARGEST_TEXTURE = 256  # pixels of a side
AMBIENT, DIFFUSE = 0.75, 0.4  # light from everywhere, and from the house's own direction
EGL_PACKAGES = "libegl1 libgl1 libglu1-mesa libgl1-mesa-dri"
INSTALL = f"`pip install 'persist-cli[miniworld]'` and Mesa's EGL (`apt-get install {EGL_PACKAGES}`)"

Array = np.ndarray[Any, Any]


@functools.cache
def assets() -> Path:
    """The folder of MiniWorld that holds ``textures`` and ``meshes``.

    Raises:
        PluginError: when the package is not installed.
    """
    spec = importlib.util.find_spec("miniworld")
    if spec is None or not spec.submodule_search_locations or not is_installed():
        raise PluginError(f"simulator 'miniworld' needs the package miniworld: {INSTALL}")
    return Path(spec.submodule_search_locations[0])


def is_installed() -> bool:
    """Whether the packages of MiniWorld are here; whether OpenGL is shows when it is used."""
    return all(importlib.util.find_spec(name) is not None for name in ("miniworld", "pyglet"))


@functools.cache
def _context() -> tuple[Any, Any]:
    """OpenGL's functions, and the one invisible window of this process that they draw for.

    Raises:
        PluginError: when OpenGL is not available without a screen.
    """
    assets()
    os.environ.setdefault("LP_NUM_THREADS", "1")  # Mesa's threads only get in each other's way on small images
    import pyglet

    pyglet.options["headless"] = True
    pyglet.options["debug_gl"] = False  # else every call asks for errors
    pyglet.options["shadow_window"] = False  # else the import opens a window, and fails where it cannot
    try:
        from pyglet import gl
        from pyglet.window import NoSuchConfigException, NoSuchDisplayException, Window
    except (ImportError, ValueError, AttributeError) as error:
        raise PluginError(_no_egl(error)) from error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # pyglet then tries a screen; its failure is reported below
            return gl, Window(width=1, height=1, visible=False)
    except (NoSuchConfigException, NoSuchDisplayException, gl.ContextException, gl.lib.GLException) as error:
        raise PluginError(_no_egl(error)) from error


def _graphics() -> Any:
    """OpenGL's functions, switched to the window of persist whatever else this process draws."""
    gl, window = _context()
    window.switch_to()
    return gl


def _no_egl(error: Exception) -> str:
    cause = str(error).splitlines()[0] if str(error) else type(error).__name__
    return f"simulator 'miniworld' renders with Mesa's EGL ({cause}); install it with `apt-get install {EGL_PACKAGES}`"


class Renderer:
    """Draws one house at a time into images of one size.

    Args:
        height: image height in pixels.
        width: image width in pixels.

    Raises:
        PluginError: when OpenGL is not available, or has no frame buffer of this size.
    """

    def __init__(self, height: int, width: int) -> None:
        self.height, self.width = height, width
        self._gl = _graphics()
        self._walls, self._things = (self._gl.glGenLists(1) for _ in range(2))
        self._house: House | None = None  # whose walls are drawn
        self._sampled, self._resolved, self._single = (self._frame_buffer(count) for count in (SAMPLES, 0, 0))
        self._set_up()

    def load(self, house: House, things: Sequence[Thing]) -> None:
        """Draw this house, with its things as they are now, in all images until the next call."""
        gl = _graphics()
        if house is not self._house:
            walls = _by_texture(house_panels(house, ()))
            with self._recorded(self._walls):
                gl.glLightfv(gl.GL_LIGHT0, gl.GL_POSITION, (gl.GLfloat * 4)(*house.light, 0.0))
                self._draw_panels(walls)
            self._house = house
        meshes = [(thing, mesh(thing.shape)) for thing in things if thing.is_mesh]
        panels = _by_texture(panel for thing in things if not thing.is_mesh for panel in furniture_panels(thing))
        with self._recorded(self._things):
            self._draw_panels(panels)
            for thing, (number, shape) in meshes:
                self._draw_mesh(thing, number, shape)

    @contextlib.contextmanager
    def _recorded(self, number: Any) -> Iterator[None]:
        """What is drawn in the block is the display list of this number; textures of it must be uploaded before."""
        self._gl.glNewList(number, self._gl.GL_COMPILE)
        yield
        self._gl.glEndList()

    def render(self, eye: Sequence[float], forward: Sequence[float], fov: float) -> tuple[Array, Array]:
        """Render the view from a point, with +y up.

        Args:
            eye: position in world metres.
            forward: direction of the view.
            fov: degrees from the top of the image to its bottom.

        Returns:
            rgb uint8 ``[height, width, 3]``, and planar depth float32 metres ``[height, width]``, 0 for the sky.
        """
        gl = _graphics()
        self._draw(self._sampled, eye, forward, fov)
        gl.glBindFramebuffer(gl.GL_READ_FRAMEBUFFER, self._sampled)
        gl.glBindFramebuffer(gl.GL_DRAW_FRAMEBUFFER, self._resolved)
        whole = (0, 0, self.width, self.height)
        gl.glBlitFramebuffer(*whole, *whole, gl.GL_COLOR_BUFFER_BIT, gl.GL_NEAREST)
        rgb = np.empty((self.height, self.width, 3), np.uint8)
        self._read(self._resolved, gl.GL_RGB, gl.GL_UNSIGNED_BYTE, rgb)
        self._write_colors(False)
        self._draw(self._single, eye, forward, fov)
        self._write_colors(True)
        buffer = np.empty((self.height, self.width), np.float32)
        self._read(self._single, gl.GL_DEPTH_COMPONENT, gl.GL_FLOAT, buffer)
        depth = NEAR * FAR / (FAR - buffer.astype(np.float64) * (FAR - NEAR))
        depth[depth >= SKY] = 0.0
        return np.ascontiguousarray(rgb[::-1]), np.ascontiguousarray(depth[::-1]).astype(np.float32)

    def _draw(self, frame_buffer: Any, eye: Sequence[float], forward: Sequence[float], fov: float) -> None:
        gl = self._gl
        gl.glBindFramebuffer(gl.GL_FRAMEBUFFER, frame_buffer)
        gl.glViewport(0, 0, self.width, self.height)
        gl.glClearColor(*SKY_COLOUR, 1.0)
        gl.glClear(gl.GL_COLOR_BUFFER_BIT | gl.GL_DEPTH_BUFFER_BIT)
        gl.glMatrixMode(gl.GL_PROJECTION)
        gl.glLoadIdentity()
        gl.gluPerspective(fov, self.width / self.height, NEAR, FAR)
        gl.glMatrixMode(gl.GL_MODELVIEW)
        gl.glLoadIdentity()
        target = [start + offset for start, offset in zip(eye, forward, strict=True)]
        gl.gluLookAt(*eye, *target, 0.0, 1.0, 0.0)
        for part in (self._walls, self._things):
            gl.glCallList(part)

    def _read(self, frame_buffer: Any, channels: int, kind: int, into: Array) -> None:
        gl = self._gl
        gl.glBindFramebuffer(gl.GL_FRAMEBUFFER, frame_buffer)
        gl.glPixelStorei(gl.GL_PACK_ALIGNMENT, 1)
        gl.glReadPixels(0, 0, self.width, self.height, channels, kind, into.ctypes.data_as(ctypes.c_void_p))

    def _write_colors(self, enabled: bool) -> None:
        """Draw colours and depth from now on, or depth alone."""
        gl = self._gl
        gl.glColorMask(*(4 * [enabled]))
        for switch in (gl.GL_TEXTURE_2D, gl.GL_LIGHTING):
            (gl.glEnable if enabled else gl.glDisable)(switch)

    def _frame_buffer(self, samples: int) -> Any:
        """A frame buffer with eight bits a colour and 32 bits of depth; 0 samples for a plain one."""
        gl = self._gl
        frame_buffer = gl.GLuint()
        gl.glGenFramebuffers(1, frame_buffer)
        gl.glBindFramebuffer(gl.GL_FRAMEBUFFER, frame_buffer)
        attachments = ((gl.GL_COLOR_ATTACHMENT0, gl.GL_RGB8), (gl.GL_DEPTH_ATTACHMENT, gl.GL_DEPTH_COMPONENT32F))
        for attachment, kind in attachments:
            buffer = gl.GLuint()
            gl.glGenRenderbuffers(1, buffer)
            gl.glBindRenderbuffer(gl.GL_RENDERBUFFER, buffer)
            gl.glRenderbufferStorageMultisample(gl.GL_RENDERBUFFER, samples, kind, self.width, self.height)
            gl.glFramebufferRenderbuffer(gl.GL_FRAMEBUFFER, attachment, gl.GL_RENDERBUFFER, buffer)
        if gl.glCheckFramebufferStatus(gl.GL_FRAMEBUFFER) != gl.GL_FRAMEBUFFER_COMPLETE:
            size = f"{self.height}x{self.width}"
            raise PluginError(
                f"simulator 'miniworld': this OpenGL has no frame buffer of {size} pixels; take a smaller one"
            )
        return frame_buffer

    def _set_up(self) -> None:
        gl = self._gl
        gl.glColorMaterial(gl.GL_FRONT_AND_BACK, gl.GL_AMBIENT_AND_DIFFUSE)
        switches = (gl.GL_DEPTH_TEST, gl.GL_CULL_FACE, gl.GL_TEXTURE_2D, gl.GL_LIGHTING, gl.GL_LIGHT0)
        for switch in (*switches, gl.GL_COLOR_MATERIAL, gl.GL_NORMALIZE, gl.GL_MULTISAMPLE):
            gl.glEnable(switch)
        gl.glLightModelfv(gl.GL_LIGHT_MODEL_AMBIENT, (gl.GLfloat * 4)(0.0, 0.0, 0.0, 1.0))
        gl.glLightfv(gl.GL_LIGHT0, gl.GL_AMBIENT, (gl.GLfloat * 4)(AMBIENT, AMBIENT, AMBIENT, 1.0))
        gl.glLightfv(gl.GL_LIGHT0, gl.GL_DIFFUSE, (gl.GLfloat * 4)(DIFFUSE, DIFFUSE, DIFFUSE, 1.0))

    def _draw_panels(self, by_texture: Sequence[tuple[Any, Sequence[Panel]]]) -> None:
        gl = self._gl
        for number, panels in by_texture:
            gl.glBindTexture(gl.GL_TEXTURE_2D, number)
            gl.glBegin(gl.GL_QUADS)
            for panel in panels:
                gl.glColor3f(*panel.tint)
                gl.glNormal3f(*panel.normal.tolist())
                for tile, corner in zip(panel.tiles.tolist(), panel.corners.tolist(), strict=True):
                    gl.glTexCoord2f(*tile)
                    gl.glVertex3f(*corner)
            gl.glEnd()

    def _draw_mesh(self, thing: Thing, number: int, shape: Mesh) -> None:
        gl = self._gl
        scale = mesh_scale(thing, shape)
        gl.glPushMatrix()
        gl.glTranslatef(thing.ground[0], thing.elevation, thing.ground[1])
        gl.glRotatef(math.degrees(thing.heading), 0.0, 1.0, 0.0)
        gl.glScalef(scale, scale, scale)
        gl.glCallList(number)
        gl.glPopMatrix()


def _by_texture(panels: Iterable[Panel]) -> list[tuple[Any, list[Panel]]]:
    """Panels with the OpenGL number of their texture: a change of texture costs as much as thirty panels."""
    ordered = sorted(panels, key=lambda panel: panel.texture)
    return [(texture(name), list(group)) for name, group in groupby(ordered, key=lambda panel: panel.texture)]


@functools.cache
def texture(name: str) -> Any:
    """The OpenGL number of one of MiniWorld's textures; ``portraits/7`` is the eighth portrait by name."""
    return _upload(texture_file(name))


@functools.cache
def texture_file(name: str) -> Path:
    """The image file of one of MiniWorld's textures."""
    folder = assets() / "textures"
    if name.startswith("portraits/"):
        portraits = sorted((folder / "portraits").glob("*.png"))
        return portraits[int(name.removeprefix("portraits/")) % len(portraits)]
    return folder / f"{name}.png"


@functools.cache
def _upload(path: Path) -> Any:
    """The OpenGL number of an image file, uploaded with smaller copies for the distance."""
    gl = _graphics()
    with Image.open(path) as file:
        image = file.convert("RGB")
    image = image.resize([min(side, LARGEST_TEXTURE) for side in image.size], Image.Resampling.BOX)
    number = gl.GLuint()
    gl.glGenTextures(1, number)
    gl.glBindTexture(gl.GL_TEXTURE_2D, number)
    gl.glPixelStorei(gl.GL_UNPACK_ALIGNMENT, 1)
    pixels = image.transpose(Image.Transpose.FLIP_TOP_BOTTOM).tobytes()
    gl.glTexImage2D(
        gl.GL_TEXTURE_2D, 0, gl.GL_RGB8, *image.size, 0, gl.GL_RGB, gl.GL_UNSIGNED_BYTE, pixels
    )  # fmt: skip
    gl.glGenerateMipmap(gl.GL_TEXTURE_2D)
    gl.glTexParameteri(gl.GL_TEXTURE_2D, gl.GL_TEXTURE_MIN_FILTER, gl.GL_LINEAR_MIPMAP_LINEAR)
    gl.glTexParameteri(gl.GL_TEXTURE_2D, gl.GL_TEXTURE_MAG_FILTER, gl.GL_LINEAR)
    return number


@functools.cache
def mesh_shape(name: str) -> Mesh:
    """One of MiniWorld's meshes."""
    return read_mesh(assets() / "meshes" / f"{name}.obj")


@functools.cache
def mesh(name: str) -> tuple[int, Mesh]:
    """The OpenGL display list of one of MiniWorld's meshes, in the file's units, and the mesh."""
    gl = _graphics()
    shape = mesh_shape(name)
    textures = [_upload(part.image) if part.image else texture("white_1") for part in shape.parts]
    number = gl.glGenLists(1)
    gl.glNewList(number, gl.GL_COMPILE)
    for part, image in zip(shape.parts, textures, strict=True):
        _draw_part(gl, part, image)
    gl.glEndList()
    return number, shape


def mesh_scale(thing: Thing, shape: Mesh) -> float:
    """Metres of a thing for one unit of its mesh's file."""
    return min(thing.size[1] / shape.height, thing.radius / shape.radius)


def _draw_part(gl: Any, part: MeshPart, image: Any) -> None:
    gl.glBindTexture(gl.GL_TEXTURE_2D, image)
    gl.glColor3f(*part.colour)
    gl.glBegin(gl.GL_TRIANGLES)
    for tile, normal, vertex in _rows(part.tiles, part.normals, part.vertices):
        gl.glTexCoord2f(*tile)
        gl.glNormal3f(*normal)
        gl.glVertex3f(*vertex)
    gl.glEnd()


def _rows(*arrays: Array) -> Iterable[tuple[list[float], ...]]:
    return zip(*(array.tolist() for array in arrays), strict=True)
