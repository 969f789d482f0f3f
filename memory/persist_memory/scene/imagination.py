"""Imagining the unknown cells of a grid by a scene model, window by window, the nearest first.

A window lies at whole cells. What is known in it is given to the model, what an earlier window imagined too, so that
neighbouring windows go on from each other.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.cell_rays import first_surfaces, sheet_cells
from persist_cli.api.cells import SOLID, CellGrid, CellOrigin
from persist_cli.api.geometry import unproject
from persist_cli.api.promises import check_cells
from persist_cli.api.reach import cells_in_reach
from persist_cli.api.scene_model import Given, SceneForm, SceneModel, SceneSamples, no_view, window_pose
from persist_cli.api.scene_turns import Turn
from persist_cli.errors import CheckpointError
from persist_memory.scene.fusion import UNDER, surface_normals
from persist_memory.validation import Shape, part_of

Corner = tuple[int, int, int]
FORESEEN_STRIDE = 4  # pixels from ray to ray that look for unknown cells
REPAINTED = 48  # of 255, by which a channel must differ after an interaction: models do not keep colours to the bit
SEEDS = 2**62  # seeds of windows are smaller
MIXERS = (6364136223846793005, 3202034522624059733, 7046029254386353087, 1442695040888963407)


VIEW: dict[str, tuple[torch.dtype, Shape]] = {
    "view.rgb": (torch.uint8, (None, None, 3)),
    "view.depth": (torch.float32, (None, None)),
    "view.pose": (torch.float64, (4, 4)),
    "view.intrinsics": (torch.float64, (3, 3)),
}


@dataclass(frozen=True)
class View:
    """A frame that tells the model how the place looks.

    Args:
        rgb: uint8 RGB.
        depth: planar z in metres, 0 = missing.
        camera: its camera, single, in the world.
    """

    rgb: UInt8[Tensor, "height width 3"]
    depth: Float[Tensor, "height width"]
    camera: Cameras

    def without(self, grid: CellGrid, gone: Bool[Tensor, "first second level"]) -> View:
        """Return this view with black pixels without depth where it shows what is gone from some cells of a grid."""
        center, depth = self.camera.centers.double().cpu(), self.depth.cpu()
        rays = (unproject(depth, self.camera.to("cpu")) - center)[None]  # to what the pixels see
        inner = rays + UNDER * grid.form.size * surface_normals(rays, depth[None] > 0)  # as when frames are written
        places = grid.numbers(inner[0] + center) - torch.tensor(grid.corner)
        inside = ((places >= 0) & (places < torch.tensor(grid.shape))).all(-1) & (depth > 0)
        stale = inside.clone()
        stale[inside] = gone[tuple(places[inside].T)]
        kept = ~stale.to(self.depth.device)
        return replace(self, rgb=self.rgb * kept[..., None], depth=self.depth * kept)

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors that ``read_view`` takes back."""
        camera = self.camera
        parts = (self.rgb, self.depth, camera.world_from_camera.double(), camera.intrinsics.double())
        return dict(zip(VIEW, parts, strict=True))


def read_view(tensors: Mapping[str, Tensor], where: str) -> View | None:
    """Return the view among the tensors of a memory, ``None`` without one.

    Raises:
        CheckpointError: when a part of it is missing or damaged.
    """
    parts = part_of(tensors, VIEW, where)
    if not parts:
        return None
    rgb, depth, pose, matrix = parts
    if rgb.shape[:2] != depth.shape:
        raise CheckpointError(f"{where}: its view has an image of {list(rgb.shape)} and depth of {list(depth.shape)}")
    return View(rgb, depth, Cameras(pose, matrix, depth.shape[0], depth.shape[1]))


@dataclass(frozen=True)
class Carried:
    """What the agent carries.

    Args:
        kind: its class, 0 for nothing.
        color: its mean RGB, uint8.
    """

    kind: int
    color: UInt8[Tensor, " 3"]


@dataclass(frozen=True)
class Imagination:
    """A scene model and what it is told beside the cells.

    Args:
        model: the model, ready to sample.
        steps: its denoising steps.
        view: the newest observed frame, ``None`` without one.
        floor: number of the floor's level, with which windows begin.
        carried: what the agent carries.
    """

    model: SceneModel
    steps: int
    view: View | None
    floor: int
    carried: Carried

    def check(self, grid: CellGrid) -> None:
        """Raise ``CheckpointError`` when the cells are not those that the model knows."""
        form = self.model.form.cells
        if grid.form.size != form.size:
            raise CheckpointError(
                f"the scene's cells are {grid.form.size:g} m wide, those of the model {form.size:g} m; "
                f"make the scene with memory.size={form.size:g}"
            )
        if grid.form.palette != form.palette:
            raise CheckpointError(
                f"the scene has the classes {', '.join(grid.form.palette)}, the model knows {', '.join(form.palette)}; "
                "make the scene with the model's own, as `persist memorize --memory scene --model` does"
            )

    def around(self, center: Sequence[int]) -> Corner:
        """Return the corner of the window around a cell, from the floor up."""
        first, second, _ = self.model.form.shape
        return center[0] - first // 2, center[1] - second // 2, self.floor

    def fill(self, window: CellGrid, seed: int) -> CellGrid:
        """Return a window with all its unknown cells imagined, and with the class of what was solid and nothing more.

        Args:
            window: a box of the model's shape.
            seed: seed of the draw; the window's place changes it.
        """
        given = torch.where(window.known, int(Given.CONTENT), int(Given.NOTHING)).to(torch.uint8)
        classes, colors = self.sample(window, given, 0, seed)
        unknown, unnamed = ~window.known, window.known & (window.classes == SOLID)
        filled = window.copy()
        filled.classes[unknown | unnamed] = classes[unknown | unnamed]
        filled.classes[unnamed & ~filled.solid] = SOLID
        filled.origins[unknown] = CellOrigin.IMAGINED
        filled.colors[unknown] = colors[unknown] * filled.solid[unknown][:, None]
        return filled

    def sample(
        self, window: CellGrid, given: UInt8[Tensor, "first second level"], action: int, seed: int
    ) -> tuple[UInt8[Tensor, "first second level"], UInt8[Tensor, "first second level 3"]]:
        """Return classes and colours that the model draws for a window.

        Args:
            window: a box of the model's shape.
            given: the ``Given`` of each cell.
            action: 0 for none, or 1 + the number of an interaction that the model knows.
            seed: seed of the draw; the window's place changes it.
        """
        number = window_seed(seed, window.corner)
        turned, sample = self._sample_of(window, given, action, self._seen(window), number)
        with torch.inference_mode():
            drawn = self.model.sample(sample, self.steps)
        here = window.classes.device
        self._check(drawn, "sample")
        classes, colors = (turned.back(part[0]).to(here) for part in drawn)
        return classes.clone(), colors.clone()

    def outcome(
        self, window: CellGrid, given: UInt8[Tensor, "first second level"], action: int, pose: Float[Tensor, "4 4"]
    ) -> CellGrid | None:
        """Return a window after an interaction; ``None`` where the model has no network for that.

        Args:
            window: a box of the model's shape.
            given: the ``Given`` of each cell.
            action: 1 + the number of the interaction.
            pose: world_from_camera of the agent.
        """
        rgb, depth, _, matrix = no_view(self.model.form)
        view = rgb, depth, window_pose(window, pose.cpu()), matrix
        turned, sample = self._sample_of(window, given, action, view)
        with torch.inference_mode():
            said = self.model.outcome(sample)
        if said is None:
            return None
        self._check(said, "outcome")
        classes, colors = (turned.back(part[0]).to(window.classes.device).clone() for part in said)
        return replace(window, classes=classes, colors=colors)

    def _sample_of(
        self,
        window: CellGrid,
        given: UInt8[Tensor, "first second level"],
        action: int,
        view: tuple[Tensor, Tensor, Tensor, Tensor],
        seed: int = 0,
    ) -> tuple[Turn, SceneSamples]:
        """Return a batch of one sample, turned as in training so that its camera looks along the first axis, and how.

        Args:
            window: a box of the model's shape.
            given: the ``Given`` of each cell.
            action: 0 for none, or 1 + the number of an interaction that the model knows.
            view: RGB, depth, pose in the window and intrinsics.
            seed: of all random numbers.
        """
        rgb, depth, pose, matrix = view
        known, form = given > Given.NOTHING, self.model.form
        turned = Turn.ahead(pose, form.shape)
        told = (given, window.classes * known, window.colors * known[..., None])
        given, classes, colors = (turned.cells(part) for part in told)
        sample = SceneSamples(
            given, classes, colors, rgb, depth, turned.pose(pose, form).float(), matrix, torch.tensor(action),
            torch.tensor(self.carried.kind), self.carried.color.cpu(), torch.tensor(seed),
        )  # fmt: skip
        return turned, SceneSamples.stack([sample.to("cpu")]).to(self.device)

    def _check(self, cells: object, method: str) -> None:
        """Raise ``PluginError`` when cells of one window, which a method of the model gave, are none."""
        form = self.model.form
        check_cells(cells, self.model.name, method, (1, *form.shape), len(form.cells.palette))

    @property
    def device(self) -> torch.device:
        """Where the model is."""
        return next(self.model.parameters()).device

    def coded(self, window: CellGrid, drawn: CellGrid) -> CellGrid:
        """Return a window as the model's codec holds it, in which small things may be lost and colours are dull.

        Args:
            window: the cells.
            drawn: says what is in unknown cells, and of what class solid ones are.
        """
        unnamed = window.known & (window.classes == SOLID) & drawn.solid
        classes = torch.where(window.known & ~unnamed, window.classes, drawn.classes)
        colors = torch.where(window.known[..., None], window.colors, drawn.colors)
        turned = Turn.ahead(self._seen(window)[2], self.model.form.shape)  # the codec sees what ``sample`` lets it see
        told = (turned.cells(part)[None].to(self.device) for part in (classes, colors))
        with torch.inference_mode():
            held = self.model.reconstruct(*told)
        self._check(held, "reconstruct")
        classes, colors = (turned.back(part[0]).to(window.classes.device).clone() for part in held)
        return replace(window, classes=classes, colors=colors)

    def _seen(self, window: CellGrid) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return RGB, depth, pose and intrinsics of the view, for a window; without a view in it all pixels are 0."""
        form = self.model.form
        if self.view is None:
            return no_view(form)
        view = resized(self.view, *form.image)
        pose = window_pose(window, view.camera.world_from_camera.cpu())
        place = (pose[:3, 3] / window.form.size).round()
        if bool(((place < 0) | (place >= place.new_tensor(window.shape)))[:2].any()):
            return no_view(form)  # far from here: it shows another place
        return view.rgb.cpu(), view.depth.cpu(), pose.float(), view.camera.intrinsics.float().cpu()


def resized(view: View, height: int, width: int) -> View:
    """Return a view at another image size: colours as means, depths as those of the nearest pixel."""
    if view.depth.shape == (height, width):
        return view
    rgb = view.rgb.movedim(-1, 0)[None].float()
    rgb = torch.nn.functional.interpolate(rgb, (height, width), mode="bilinear", antialias=True, align_corners=False)
    depth = torch.nn.functional.interpolate(view.depth[None, None], (height, width), mode="nearest-exact")[0, 0]
    image = rgb[0].round().clamp(0, 255).to(torch.uint8).movedim(0, -1)
    return View(image, depth, view.camera.resized(height, width))


def window_seed(seed: int, corner: Corner) -> int:
    """Return the seed of a window's draw, another one for each place, equal on all machines."""
    mixed = 0
    for value, mixer in zip((seed, *corner), MIXERS, strict=True):
        mixed = ((mixed ^ (value % SEEDS)) * mixer + (mixed >> 29)) % SEEDS
    return mixed


def windows_over(
    low: Sequence[int], high: Sequence[int], form: SceneForm, center: Sequence[int]
) -> list[tuple[int, int]]:
    """Return corners on the ground of windows that cover a piece of it together, the nearest to a cell first.

    A piece that is no larger than a window gets one window around its middle. Else windows overlap by half, so that
    each goes on from the one before.

    Args:
        low: first and second number of the lowest cell.
        high: those after the highest.
        form: the windows' shape.
        center: numbers of the cell.
    """
    corners = []
    for a, b, side in zip(low[:2], high[:2], form.shape[:2], strict=True):
        count = 1 if b - a <= side else math.ceil((b - a - side) / (side // 2)) + 1
        first = (a + b - side - (count - 1) * (side // 2)) // 2
        corners.append([first + number * (side // 2) for number in range(count)])
    places = [(x, y) for x in corners[0] for y in corners[1]]
    half = [side // 2 for side in form.shape[:2]]
    places.sort(key=lambda p: ((p[0] + half[0] - center[0]) ** 2 + (p[1] + half[1] - center[1]) ** 2, p))
    return places


def sees_unknown(window: CellGrid, camera: Cameras, foresight: float, floor: int) -> bool:
    """Whether a camera stands in an unknown cell of a window, or a ray of it meets one before any surface."""
    if _stands_in_unknown(window, camera):
        return True  # to its rays the unknown around it is no surface
    views = camera.resized(max(1, camera.height // FORESEEN_STRIDE), max(1, camera.width // FORESEEN_STRIDE))
    classes = torch.where(window.known, window.classes, len(window.form.palette)).to(torch.uint8)
    marked = replace(window, classes=classes)  # unknown cells are a thing of their own
    surfaces = first_surfaces(marked, views, 1, window.solid | ~window.known, sheet_cells(window, floor))
    unknown = ~window.known.flatten()[surfaces.cells[0].clamp_min(0)]
    return bool((unknown & surfaces.hit[0] & (surfaces.depth[0] < foresight)).any())


def _stands_in_unknown(window: CellGrid, camera: Cameras) -> bool:
    place = window.numbers(camera.centers[0]) - torch.tensor(window.corner)
    inside = bool(((place >= 0) & (place < torch.tensor(window.shape))).all())
    return inside and not bool(window.known[tuple(place)])


def imagine_hidden(
    imagination: Imagination, grid: CellGrid, hidden: Bool[Tensor, "first second level"], seed: int
) -> CellGrid:
    """Return a grid with its hidden cells imagined, as far as the model's windows reach, and all others as they were.

    Solid cells of no known class get none here, since an edit changes nothing but what it is asked to.
    """
    places = hidden.nonzero() + torch.tensor(grid.corner)
    low, high = places.amin(0).tolist(), (places.amax(0) + 1).tolist()
    center = [(a + b) // 2 for a, b in zip(low, high, strict=True)]
    result = grid.copy()
    wanted = replace(grid, origins=hidden.byte())
    for x, y in windows_over(low, high, imagination.model.form, center):
        corner = (x, y, imagination.floor)
        window = result.box(corner, imagination.model.form.shape)
        chosen = ~window.known & wanted.box(corner, window.shape).known
        if bool(chosen.any()):
            filled = imagination.fill(window, seed)
            for mine, drawn in zip(window.tensors(), filled.tensors(), strict=True):
                mine[chosen] = drawn[chosen]
            result.put(window)
    return result


def evolved(
    imagination: Imagination, window: CellGrid, action: str, world_from_camera: Float[Tensor, "4 4"], seed: int
) -> CellGrid | None:
    """Return a window after an interaction, as the model says, or ``None`` when it says that nothing changes.

    The model is given the known cells in reach as what they were before, and all other known ones as they are. Where it
    has to draw the cells afterwards, they are compared with what its codec makes of those before. So what the codec
    loses is no change, and what it does not hold the model cannot take away.

    Raises:
        CheckpointError: when the model does not know this interaction.
    """
    known = imagination.model.form.actions
    if action not in known:
        raise CheckpointError(f"the scene model knows the interactions {', '.join(known)}, not {action!r}")
    reach = cells_in_reach(window, world_from_camera) & window.known
    number = 1 + known.index(action)
    given = torch.where(window.known, int(Given.CONTENT), int(Given.NOTHING))
    given = torch.where(reach, int(Given.PAST), given).to(torch.uint8)
    said = imagination.outcome(window, given, number, world_from_camera)
    if said is None:
        said, differs = _drawn(imagination, window, given, number, seed)
    else:
        differs = (said.classes != window.classes) | (said.colors != window.colors).any(-1)
    differs &= reach
    if not bool(differs.any()):
        return None
    after = window.copy()
    after.classes[differs] = said.classes[differs]
    after.colors[differs] = said.colors[differs] * after.solid[differs][:, None]
    after.origins[differs] = CellOrigin.IMAGINED
    return after


def _drawn(
    imagination: Imagination, window: CellGrid, given: UInt8[Tensor, "first second level"], action: int, seed: int
) -> tuple[CellGrid, Bool[Tensor, "first second level"]]:
    """The window that the model draws after an action, and the cells that the action changes by it."""
    classes, colors = imagination.sample(window, given, action, seed)
    after = replace(window, classes=classes, colors=colors)
    before = imagination.coded(window, after)
    other = (classes != before.classes) & (window.classes != SOLID)  # else it is only told what it is
    repainted = after.solid & before.solid & ((colors.int() - before.colors.int()).abs().amax(-1) > REPAINTED)
    differs = (after.solid != before.solid) | (after.solid & other) | repainted
    return after, differs & ((classes != window.classes) | repainted)
