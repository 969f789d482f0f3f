"""The 3D scene of the page: blocks, cameras with their pictures, ways, boxes and tokens, drawn by viser."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import torch
import viser

from persist_cli.api.cameras import Cameras
from persist_cli.api.cells import Box
from persist_cli.api.ground import ground_axes
from persist_cli.api.observations import Observations
from persist_cli.api.tokens import MemoryTokens
from persist_cli.output.map import ABOVE_CAMERA, PATH_COLORS
from persist_cli.viewer.block_mesh import block_mesh
from persist_cli.viewer.camera_view import pose_of
from persist_cli.viewer.drawn_cells import POINT, DrawnCells, cells_of_frames, painted
from persist_cli.viewer.level_of_detail import DetailTree
from persist_cli.viewer.subject import MAP, TRUTH, DrawnWalk, Subject

Array = np.ndarray[Any, Any]

FRUSTA: Final = 24  # cameras of a walk that are drawn all the time
TRUTH_COLOR: Final = (0, 121, 107)
SELECTED_COLOR: Final = (216, 27, 96)
TOKEN_COLOR: Final = (255, 214, 0)
CHANGED, REMOVED, SAME = (216, 27, 96), (30, 136, 229), (205, 205, 205)  # of cells, by what an edit did
FULL_SIZE: Final = 0.35  # metres from the middle to the picture of the present camera
GAP: Final = 1.0  # metres between what is imagined and the truth beside it
EDGES: Final = ((0, 1), (0, 2), (0, 4), (1, 3), (1, 5), (2, 3), (2, 6), (3, 7), (4, 5), (4, 6), (5, 7), (6, 7))


@dataclass
class Look:
    """How blocks are drawn.

    Args:
        colors: ``color``, ``origin`` or ``class``.
        form: ``cubes`` or ``points``.
        cut: metres of height above which nothing is drawn.
        most: the greatest number of blocks of a layer.
        beside: whether the truth stands beside the rest, not in its place.
        layers: names of the layers that are drawn.
    """

    colors: str = "color"
    form: str = "cubes"
    cut: float = math.inf
    most: int = 40_000
    beside: bool = True
    layers: set[str] = field(default_factory=set)


class Stage:
    """Draws a subject.

    Args:
        server: the page's server.
        subject: what is drawn.
        look: how; ``draw`` draws anew after it was changed.
    """

    def __init__(self, server: viser.ViserServer, subject: Subject, look: Look) -> None:
        self.server, self.scene, self.subject, self.look = server, server.scene, subject, look
        self.axes: Array = ground_axes(subject.world_up).numpy()
        self.layers = dict(subject.layers)
        self.shows_changes = False  # of the map, whatever the colours of the other layers
        self.drawn: dict[str, tuple[int, int]] = {}  # blocks, and cells that they stand for
        self._trees: dict[str, tuple[DrawnCells, float, DetailTree]] = {}
        self._forms: dict[str, str] = {}  # in which each layer was drawn last
        self.scene.set_up_direction(subject.world_up)
        self._truth = self.scene.add_frame(f"/{TRUTH}", show_axes=False, position=self.truth_offset())
        look.cut = min(look.cut, self.default_cut())
        self._set_first_view()
        self.draw_walks()
        self.draw()

    def bounds(self) -> tuple[Array, Array]:
        """Return the lowest and highest coordinates of all that is drawn along the ground axes and up, metres."""
        places = [cells.centers @ self.axes.T for cells in self.layers.values() if len(cells)]
        places += [walk.cameras.centers.double().numpy() @ self.axes.T for walk in self.subject.walks]
        if not places:
            return np.full(3, -1.0), np.full(3, 1.0)
        return np.min([part.min(axis=0) for part in places], axis=0), np.max([p.max(axis=0) for p in places], axis=0)

    def default_cut(self) -> float:
        """Return the height just above the highest camera, where a ceiling is cut away.

        It is infinite without a camera, or where a layer has nothing below it, as a flat map of unknown height may.
        """
        heights = [walk.cameras.centers.double().numpy() @ self.axes[2] for walk in self.subject.walks]
        cut = float(max(part.max() for part in heights)) + ABOVE_CAMERA if heights else math.inf
        lowest = [float(self.heights(cells).min()) for cells in self.layers.values() if len(cells)]
        return cut if all(low <= cut for low in lowest) else math.inf

    def truth_offset(self) -> tuple[float, float, float]:
        """Return by how many metres the truth stands beside the rest."""
        if TRUTH not in self.layers or not self.look.beside:
            return 0.0, 0.0, 0.0
        low, high = self.bounds()
        x, y, z = (self.axes[0] * (high[0] - low[0] + GAP)).tolist()
        return x, y, z

    def draw(self, focus: Array | None = None) -> None:
        """Draw all layers that are shown.

        Args:
            focus: a place in world metres near which a map that has too many cells is drawn in more detail.
        """
        self._truth.position = self.truth_offset()
        for name in self.layers:
            if name in self.look.layers:
                self.draw_layer(name, focus)
            else:
                self._remove(_node(name))
                self.drawn.pop(name, None)

    def draw_layer(self, name: str, focus: Array | None = None) -> None:
        """Draw the blocks of a layer; arguments as of ``draw``."""
        if self._forms.get(name) != self.look.form:  # viser keeps what is below a node that is drawn anew
            self._remove(_node(name))
            self._forms[name] = self.look.form
        if name == TRUTH and focus is not None:
            focus = focus - np.asarray(self._truth.position)
        tree = self._tree(name)
        parts = [part for part in tree.select(self.look.most, focus) if len(part)]
        self.drawn[name] = sum(map(len, parts)), tree.count
        if not parts:
            self._remove(_node(name))
        elif self.look.form == "points":
            self._draw_points(name, parts)
        else:
            mesh, middle = block_mesh([(part, painted(part, self._colors(name))) for part in parts])
            self.scene.add_glb(_node(name), mesh, position=_triple(middle), cast_shadow=False, receive_shadow=False)

    def shown(self, cells: DrawnCells) -> Array:
        """Return which blocks lie below the cut."""
        below: Array = self.heights(cells) <= self.look.cut
        return below

    def heights(self, cells: DrawnCells) -> Array:
        """Return how high the middles of blocks lie along up, metres."""
        heights: Array = cells.centers @ self.axes[2]
        return heights

    def set_changes(self, before: DrawnCells, after: DrawnCells) -> None:
        """Let the map be grey, with what an edit changed in one colour and what it took away in another."""
        old, new = (_content(cells) for cells in (before, after))
        gone = before[~np.isin(_places(before), _places(after))]
        colors = np.where(np.isin(new, old)[:, None], np.array(SAME), np.array(CHANGED))
        merged = DrawnCells(
            np.concatenate([after.centers, gone.centers]),
            np.concatenate([colors, np.tile(REMOVED, (len(gone), 1))]).astype(np.uint8),
            np.concatenate([after.origins, gone.origins]),
            np.concatenate([after.kinds, gone.kinds]),
            after.size,
            after.axes,
        )
        self.layers[MAP], self.shows_changes = merged, True

    def draw_walks(self) -> None:
        """Draw each way as a line, and some of its cameras with their pictures."""
        for number, walk in enumerate(self.subject.walks):
            root, color = _walk_node(number, walk), _walk_color(number, walk)
            centers = walk.cameras.centers.double().numpy()
            if len(walk) > 1:
                ends, middle = _about_middle(np.stack([centers[:-1], centers[1:]], axis=1))
                self.scene.add_line_segments(f"{root}/way", ends, color, thickness=0.02, position=middle)
            for frame in np.unique(np.linspace(0, len(walk) - 1, min(FRUSTA, len(walk))).round().astype(int)):
                self.draw_camera(f"{root}/camera {walk.numbers[frame]}", walk, int(frame), 0.12, color)

    def draw_camera(
        self, node: str, walk: DrawnWalk, frame: int, size: float, color: tuple[int, int, int] = SELECTED_COLOR
    ) -> None:
        """Draw one camera of a walk with its picture, ``size`` metres deep."""
        picture = None if walk.pictures is None else walk.pictures[frame].numpy()
        self.draw_frustum(node, walk.cameras[frame : frame + 1], picture, size, color)

    def draw_frustum(
        self, node: str, camera: Cameras, picture: Array | None, size: float, color: tuple[int, int, int]
    ) -> None:
        """Draw a camera, which has a frame axis of one, with its picture, ``size`` metres deep."""
        wxyz, position = pose_of(camera.world_from_camera[0])
        fov = 2 * math.atan(camera.height / 2 / float(camera.intrinsics[0, 1, 1]))
        self.scene.add_camera_frustum(
            node, fov, camera.width / camera.height, scale=size, color=color, image=picture, wxyz=wxyz,
            position=position, thickness=0.008, cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def draw_time(self, frame: int) -> None:
        """Draw the present camera of each walk large, with the points that its depth shows."""
        for number, walk in enumerate(self.subject.walks):
            root, frame_here = _walk_node(number, walk), min(frame, len(walk) - 1)
            self.draw_camera(f"{root}/now", walk, frame_here, FULL_SIZE)
            if walk.depth is not None and walk.pictures is not None:
                self._draw_seen(f"{root}/seen", walk, frame_here)

    def draw_boxes(self, boxes: list[Box]) -> None:
        """Draw the edges of selected boxes; none removes them."""
        if not boxes:
            return self._remove("/selection")
        segments = []
        for box in boxes:
            corners = torch.cartesian_prod(*torch.tensor([box.low, box.high]).T.unbind(0)).numpy()
            segments += [corners[list(edge)] for edge in EDGES]
        edges, middle = _about_middle(np.stack(segments))
        self.scene.add_line_segments("/selection", edges, SELECTED_COLOR, thickness=0.025, position=middle)
        return None

    def draw_tokens(self, tokens: MemoryTokens | None) -> None:
        """Draw what a camera read from the memory: points where its tokens are, cameras for those that are images."""
        self._remove("/reading")
        if tokens is None or not len(tokens):
            return
        if tokens.images is not None and tokens.world_from_camera is not None and tokens.intrinsics is not None:
            cameras = Cameras(tokens.world_from_camera, tokens.intrinsics, *tokens.images.shape[1:3])
            for number in range(len(tokens)):
                one = cameras[number : number + 1]
                self.draw_frustum(f"/reading/{number}", one, tokens.images[number].numpy(), 0.25, TOKEN_COLOR)
            return
        points, middle = _about_middle(tokens.positions.double().numpy())
        self.scene.add_point_cloud(
            "/reading/tokens", points, TOKEN_COLOR, point_size=0.06, point_shape="circle", precision="float32",
            position=middle,
        )  # fmt: skip

    def _tree(self, name: str) -> DetailTree:
        """Return the blocks of a layer below the cut in all widths; they are made anew when one of these changed."""
        cells, cut = self.layers[name], self.look.cut
        kept = self._trees.get(name)
        if kept is None or kept[0] is not cells or kept[1] != cut:
            kept = cells, cut, DetailTree(cells[self.shown(cells)])
            self._trees[name] = kept
        return kept[2]

    def set_map(self, cells: DrawnCells) -> None:
        """Let the map be other cells."""
        self.layers[MAP], self.shows_changes = cells, False

    def _colors(self, layer: str) -> str:
        return "color" if layer == MAP and self.shows_changes else self.look.colors

    def _draw_points(self, layer: str, parts: list[DrawnCells]) -> None:
        node = _node(layer)
        self._remove(node)
        for part in parts:
            width = part.size[0]
            points, middle = _about_middle(part.centers)
            self.scene.add_point_cloud(
                f"{node}/{width:g} m", points, painted(part, self._colors(layer)), point_size=width,
                precision="float32", point_shading="flat", position=middle,
            )  # fmt: skip

    def _draw_seen(self, node: str, walk: DrawnWalk, frame: int) -> None:
        assert walk.pictures is not None
        assert walk.depth is not None
        part = slice(frame, frame + 1)
        seen = Observations(walk.pictures[part], walk.depth[part], walk.cameras[part])
        cells = cells_of_frames(seen, self.subject.world_up)
        points, middle = _about_middle(cells.centers)
        self.scene.add_point_cloud(
            node, points, cells.colors, point_size=POINT / 2, precision="float32", position=middle
        )  # fmt: skip

    def _set_first_view(self) -> None:
        """Let a page begin with all in view, from above at an angle."""
        low, high = self.bounds()
        middle, reach = (low + high) / 2, max(float(np.linalg.norm((high - low)[:2])), 1.0)
        offset = np.array([0.25, -0.55, 0.6]) * reach
        camera = self.server.initial_camera
        camera.position = _triple((middle + offset) @ self.axes)
        camera.look_at = _triple(middle @ self.axes)
        camera.up = _triple(self.axes[2])

    def _remove(self, node: str) -> None:
        self.scene.remove_by_name(node)


def _node(layer: str) -> str:
    return f"/{TRUTH}/cells" if layer == TRUTH else f"/layers/{layer}"


def _walk_node(number: int, walk: DrawnWalk) -> str:
    return f"/{TRUTH}/walk" if walk.is_truth else f"/walks/{number} {walk.name.replace('/', ' ')}"


def _walk_color(number: int, walk: DrawnWalk) -> tuple[int, int, int]:
    if walk.is_truth:
        return TRUTH_COLOR
    text = PATH_COLORS[number % len(PATH_COLORS)].removeprefix("#")
    red, green, blue = bytes.fromhex(text)
    return red, green, blue


def _about_middle(places: Array) -> tuple[Array, tuple[float, float, float]]:
    """Return places ``[..., 3]`` less their middle, which viser's 32 bits keep far from the origin too, and that."""
    if not places.size:
        return places, (0.0, 0.0, 0.0)
    points = places.reshape(-1, 3)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    return places - middle, _triple(middle)


def _places(cells: DrawnCells) -> Array:
    """Return a number for each block that says where it stands, equal in maps of one lattice."""
    numbers = cells.numbers + (1 << 20)
    places: Array = (numbers[:, 0] << 42) | (numbers[:, 1] << 21) | numbers[:, 2]
    return places


def _content(cells: DrawnCells) -> Array:
    """Return for each block a value that says where it stands and what it is."""
    parts = [_places(cells)[:, None], cells.colors.astype(np.int64), cells.kinds[:, None].astype(np.int64)]
    return np.ascontiguousarray(np.concatenate(parts, axis=1)).view([("", np.int64)] * 5)[:, 0]


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = np.asarray(values, np.float64).tolist()
    return x, y, z
