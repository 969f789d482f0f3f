"""A memory seen from above, with the paths that cameras took through it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from torch import Tensor

from persist_cli.api.cells import CellOrigin
from persist_cli.api.ground import ground_axes
from persist_cli.api.memory import MapPoints
from persist_cli.io.files import written_aside

PATH_COLORS = ("#d81b60", "#1e88e5", "#ffb300", "#004d40", "#8e24aa")
UNSEEN = (0.94, 0.94, 0.95, 1.0)
COST_COLORS = "viridis"  # of matplotlib: cheap is dark
NO_COST = "#9e9e9e"  # where it is not finite
MARGIN = 0.5  # metres around what is drawn
AROUND = 2.0  # metres around candidates
ABOVE_CAMERA = 0.1  # metres over the cameras at which the ceiling is cut away
LEAST_SPREAD = 0.08  # metres of a point's square: a far floor is seen at places further apart than small cells are
DOTS_ACROSS = 5  # dots along the side of the square that stands for a point
MOST_DOTS = 900  # dots along the longer side of the picture
STRIPE = 6  # dots from one stripe of what is imagined to the next
PALE = (0.85, 0.45)  # share of white in its stripes and between them
EDITED_COLOR = "#d81b60"  # of the stripes on what was edited, which run the other way
LONG_SIDE = 8.0  # inches
BORDER = (0.75, 0.15, 0.55, 0.35)  # inches left and right of a map, below and above, for labels and title
BAR = 1.3  # inches of a bar of colours with its label
ARROW = 0.06  # length as a share of the long side
Array = np.ndarray[Any, Any]


def draw_map(
    points: MapPoints,
    world_up: Sequence[float],
    paths: Mapping[str, Float[Tensor, "frame 4 4"]] | Sequence[Float[Tensor, "frame 4 4"]],
    out: Path,
    stops: Float[Tensor, "stop 4 4"] | None = None,
) -> None:
    """Write a PNG of the map from above, true to scale, without the points higher than the cameras.

    Args:
        points: points of a memory; without any the picture shows the paths alone. The legend says when some of them
            are imagined or edited.
        world_up: unit vector that points up in the world.
        paths: world_from_camera of each path, by the name that the legend shows, or in order without names.
        out: path of the PNG file.
        stops: world_from_camera of where a camera was stopped by something in its way, drawn as crosses.
    """

    _draw_maps({"": points}, world_up, paths, out, stops)


def draw_before_and_after(
    before: MapPoints,
    after: MapPoints,
    world_up: Sequence[float],
    paths: Mapping[str, Float[Tensor, "frame 4 4"]],
    out: Path,
) -> None:
    """Write a PNG of two maps of one place side by side; arguments as of ``draw_map``."""
    _draw_maps({"before": before, "after": after}, world_up, paths, out)


def _draw_maps(
    maps: Mapping[str, MapPoints],
    world_up: Sequence[float],
    paths: Mapping[str, Float[Tensor, "frame 4 4"]] | Sequence[Float[Tensor, "frame 4 4"]],
    out: Path,
    stops: Float[Tensor, "stop 4 4"] | None = None,
) -> None:
    """Write a PNG with maps of one place side by side, by their titles."""
    ground = ground_axes(world_up)
    named = dict(paths) if isinstance(paths, Mapping) else {str(number): path for number, path in enumerate(paths)}
    lines = {name: path.detach().cpu().double() for name, path in named.items() if len(path)}
    places = {name: (path[:, :3, 3] @ ground.T).numpy() for name, path in lines.items()}
    painted = [paint(points, ground, _ceiling(places)) for points in maps.values()]
    corners = [_limits(extent, places) for _, extent in painted]
    low, high = np.min([low for low, _ in corners], axis=0), np.max([high for _, high in corners], axis=0)
    figure, panels = _begin_figure(painted, high - low)
    for axes, (title, points) in zip(panels, maps.items(), strict=True):
        for number, (name, place) in enumerate(places.items()):
            look = _arrow(lines[name], ground, max(high - low))
            _draw_path(axes, place[:, :2], look, PATH_COLORS[number % len(PATH_COLORS)], name)
        if stops is not None and len(stops):
            _draw_stops(axes, (stops[:, :3, 3].detach().cpu().double() @ ground.T).numpy())
        handles = axes.get_legend_handles_labels()[0] if isinstance(paths, Mapping) else []
        _finish_axes(axes, low, high, handles + _origin_handles(points))
        axes.set_title(title)
    _save(figure, out)


def _origin_handles(points: MapPoints) -> list[Any]:
    """Return what a legend says of points that were not observed."""
    from matplotlib.patches import Patch

    handles = []
    if _of_origin(points, CellOrigin.IMAGINED).any():
        handles.append(Patch(facecolor="#b8b8b8", edgecolor="white", hatch="////", label="imagined"))
    if _of_origin(points, CellOrigin.EDITED).any():
        handles.append(Patch(facecolor="#b8b8b8", edgecolor=EDITED_COLOR, hatch="\\\\\\\\", label="edited"))
    return handles


@dataclass(frozen=True)
class DrawnCandidate:
    """A candidate of a plan on a map.

    Args:
        path: world_from_camera of the start and after each action.
        cost: less is nearer to the goal; where it is not finite, the path is grey.
    """

    path: Float[Tensor, "frame 4 4"]
    cost: float


def draw_candidates(
    points: MapPoints,
    world_up: Sequence[float],
    candidates: Sequence[DrawnCandidate],
    goal: Float[Tensor, " 3"] | None,
    out: Path,
) -> None:
    """Write a PNG of the map around candidates, coloured by cost, the first one on top, and the goal's place.

    Args:
        points: points of a memory; without any the picture shows the paths alone.
        world_up: unit vector that points up in the world.
        candidates: the chosen one first.
        goal: its position in the world, metres; ``None`` where it is not known.
        out: path of the PNG file.
    """
    ground = ground_axes(world_up)
    paths = [candidate.path.detach().cpu().double() for candidate in candidates]
    places = {str(number): (path[:, :3, 3] @ ground.T).numpy() for number, path in enumerate(paths)}
    image, extent = paint(points, ground, _ceiling(places))
    target = {} if goal is None else {"goal": (goal.cpu().double()[None] @ ground.T).numpy()}
    low, high = _limits(None, places | target, AROUND)
    figure, [axes] = _begin_figure([(image, extent)], high - low, bar=True)
    ends = [_arrow(path, ground, max(high - low)) for path in paths]
    _draw_costs(figure, axes, [place[:, :2] for place in places.values()], [one.cost for one in candidates])
    _draw_path(axes, places["0"][:, :2], ends[0], PATH_COLORS[0], "chosen")
    for place in target.values():
        axes.scatter(*place[0, :2], s=260, marker="*", color="#ffb300", edgecolor="black", zorder=9, label="goal")
    _finish_axes(axes, low, high, axes.get_legend_handles_labels()[0])
    _save(figure, out)


def _draw_costs(figure: Any, axes: Any, places: Sequence[Array], costs: Sequence[float]) -> None:
    """Draw lines in colours of their costs, the dearest first, with the bar of the colours."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.collections import LineCollection
    from matplotlib.colors import Normalize

    finite = [cost for cost in costs if np.isfinite(cost)]
    scale = ScalarMappable(Normalize(min(finite, default=0.0), max(finite, default=1.0)), COST_COLORS)
    rgba = scale.to_rgba(np.nan_to_num(np.array(costs), posinf=0.0, neginf=0.0))
    order = sorted(range(len(costs)), key=lambda number: -costs[number])
    colors = [rgba[number] if np.isfinite(costs[number]) else NO_COST for number in order]
    lines = [places[number] for number in order]
    axes.add_collection(LineCollection(lines, colors=colors, linewidths=1.4, zorder=2.5))
    axes.scatter(*np.stack([line[-1] for line in lines]).T, s=14, c=colors, zorder=2.6)
    figure_width, box = figure.get_size_inches()[0], axes.get_position(original=True)
    left, width = box.x1 + 0.2 / figure_width, 0.2 / figure_width
    beside = figure.add_axes((left, box.y0 + 0.1 * box.height, width, 0.8 * box.height))
    figure.colorbar(scale, cax=beside, label="cost")


def _begin_figure(
    painted: Sequence[tuple[Array | None, tuple[float, float, float, float] | None]], size: Array, bar: bool = False
) -> tuple[Any, list[Any]]:
    """Return a figure and its axes, each with the picture of a map, for so many metres across and up.

    Args:
        painted: each picture, and its extent.
        size: metres across and up.
        bar: whether a bar of colours will stand beside each map.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    width, height = size
    scale = LONG_SIDE / max(width, height)
    left, right, below, above = BORDER  # given, since a layout that matplotlib finds takes half of the time
    right += BAR * bar
    across, up = max(3.2, width * scale + 1.0) + BAR * bar, max(2.6, height * scale + 0.8)
    figure = Figure(figsize=(across * len(painted), up))
    FigureCanvasAgg(figure)
    panels = [
        figure.add_axes(
            ((number + left / across) / len(painted), below / up,
             (1 - (left + right) / across) / len(painted), 1 - (below + above) / up)
        )
        for number in range(len(painted))
    ]  # fmt: skip
    for axes, (image, extent) in zip(panels, painted, strict=True):
        axes.set_facecolor(UNSEEN)
        if image is not None:
            axes.imshow(image, extent=extent, origin="lower", interpolation="nearest", zorder=1)
    return figure, panels


def _arrow(path: Float[Tensor, "frame 4 4"], ground: Float[Tensor, "3 3"], side: float) -> Array:
    """Return an arrow along the last view of a path, for a picture of ``side`` metres."""
    heading: Array = (path[-1, :3, 2] @ ground[:2].T).numpy()
    arrow: Array = heading / max(float(np.linalg.norm(heading)), 1e-9) * ARROW * side
    return arrow


def _save(figure: Any, out: Path) -> None:
    with written_aside(out) as aside:
        figure.savefig(aside, dpi=150, format="png", pil_kwargs={"compress_level": 1})


def paint(
    points: MapPoints, ground: Float[Tensor, "3 3"], ceiling: float | None
) -> tuple[Array | None, tuple[float, float, float, float] | None]:
    """Return the picture of some points, each square in the colour of the highest point under the ceiling.

    Squares have the size of the points' cells, and at least ``LEAST_SPREAD``.

    Observed points are drawn over imagined ones. What is imagined is pale with stripes, and what is edited has coloured
    stripes.

    Args:
        points: points to draw.
        ground: rows as ``ground_axes`` gives them.
        ceiling: height in metres; ``None`` for 60 % of the points' own height.

    Returns:
        RGBA ``[row, column, 4]`` in 0…1, the lowest row first, and its left, right, bottom and top in metres;
        ``None`` for both without points.
    """
    if not len(points.positions):
        return None, None
    places = (points.positions.detach().cpu().double() @ ground.T).numpy()
    heights = places[:, 2]
    if ceiling is None:
        ceiling = heights.min() + 0.6 * np.ptp(heights)
    visible = heights <= ceiling
    if not visible.any():
        visible[:] = True
    origins = points.origins.cpu().numpy()[visible]
    order = np.lexsort((heights[visible], origins != CellOrigin.IMAGINED))
    colors = points.colors.cpu().numpy()[visible] / 255.0
    spread = max(points.spread, LEAST_SPREAD)
    image, extent = _stamp(places[visible][order, :2], np.column_stack([colors, origins])[order], spread)
    return hatched(image), extent


def _of_origin(points: MapPoints, origin: CellOrigin) -> Array:
    return (points.origins == origin).cpu().numpy()


def hatched(image: Array) -> Array:
    """Return RGBA of an image whose fifth channel is the origin of each dot."""
    rows, columns = np.indices(image.shape[:2])
    pale = np.where((rows + columns) % STRIPE < STRIPE / 2, *PALE) * (image[..., 4] == CellOrigin.IMAGINED)
    edited = ((columns - rows) % STRIPE < STRIPE / 3) & (image[..., 4] == CellOrigin.EDITED)
    colors = image[..., :3] * (1 - pale[..., None]) + pale[..., None]
    colors[edited] = np.frombuffer(bytes.fromhex(EDITED_COLOR[1:]), np.uint8) / 255
    return np.concatenate([colors, image[..., 3:4]], axis=-1)


def _stamp(places: Array, values: Array, spread: float) -> tuple[Array, tuple[float, float, float, float]]:
    """Paint a square for each place, later ones over earlier ones; the values are RGB and one more channel.

    Returns:
        RGBA and that channel ``[row, column, 5]``, and the extent.
    """
    dot = max(spread / DOTS_ACROSS, float(np.ptp(places, axis=0).max()) / MOST_DOTS)
    low = places.min(0) - spread / 2
    across = max(1, round(spread / dot))
    columns, rows = np.ceil((places.max(0) + spread / 2 - low) / dot).astype(int) + 1
    corner = np.round((places - spread / 2 - low) / dot).astype(int)
    shift = np.arange(across)
    x = (corner[:, 0, None, None] + shift).repeat(across, axis=1)
    y = (corner[:, 1, None, None] + shift[:, None]).repeat(across, axis=2)
    image = np.zeros((rows, columns, 5))
    image[y, x] = np.insert(values, 3, 1.0, axis=1)[:, None, None]
    return image, (low[0], low[0] + columns * dot, low[1], low[1] + rows * dot)


def _ceiling(places: Mapping[str, Array]) -> float | None:
    if not places:
        return None
    return float(np.median(np.concatenate([place[:, 2] for place in places.values()]))) + ABOVE_CAMERA


def _limits(
    extent: tuple[float, float, float, float] | None, places: Mapping[str, Array], margin: float = MARGIN
) -> tuple[Array, Array]:
    corners = [place[:, :2] for place in places.values()]
    if extent is not None:
        corners.append(np.array([[extent[0], extent[2]], [extent[1], extent[3]]]))
    everything = np.concatenate(corners) if corners else np.zeros((1, 2))
    return everything.min(0) - margin, everything.max(0) + margin


def _draw_path(axes: Any, place: Array, look: Array, color: str, name: str) -> None:
    """Draw a line with white rims, a dot at the start, and at the end an arrow ``look`` along the last view."""
    axes.plot(*place.T, color="white", linewidth=4.0, solid_capstyle="round", zorder=2)
    axes.plot(*place.T, color=color, linewidth=2.0, solid_capstyle="round", zorder=3, label=name)
    axes.scatter(*place[0], s=90, color="white", edgecolor=color, linewidth=2.5, zorder=5)
    arrow = {"arrowstyle": "-|>,head_width=0.35,head_length=0.6", "color": color, "linewidth": 2.5}
    axes.annotate("", xy=place[-1] + look, xytext=place[-1], arrowprops=arrow, zorder=6)
    axes.scatter(*place[-1], s=60, color=color, edgecolor="white", linewidth=1.5, zorder=6)
    box = {"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "boxstyle": "round,pad=0.15"}
    for text, at, offset in (("start", place[0], (8, 8)), ("end", place[-1], (8, -14))):
        axes.annotate(text, at, offset, textcoords="offset points", color=color, fontsize=8, bbox=box, zorder=7)


def _draw_stops(axes: Any, place: Array) -> None:
    """Draw a cross where something was in the way."""
    axes.scatter(*place[:, :2].T, s=130, color="white", marker="X", zorder=6)
    axes.scatter(*place[:, :2].T, s=70, color="black", marker="X", zorder=6, label="blocked")


def _finish_axes(axes: Any, low: Array, high: Array, legend: list[Any]) -> None:
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    axes.set_xlabel("metres")
    axes.tick_params(labelsize=8)
    for spine in axes.spines.values():
        spine.set_color("#b0b0b0")
    bar = 1.0 if max(high - low) < 12 else 5.0
    x, y = low + 0.04 * (high - low)
    axes.plot([x, x + bar], [y, y], color="black", linewidth=3, solid_capstyle="butt", zorder=8)
    axes.annotate(f"{bar:g} m", (x + bar / 2, y), (0, 4), textcoords="offset points", ha="center", fontsize=8, zorder=8)
    if legend:
        axes.legend(handles=legend, loc="upper right", fontsize=8, framealpha=0.85)
