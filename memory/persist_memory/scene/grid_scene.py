"""The memory ``scene``: a grid of cells that is written by depth, read by rays, completed, acted on and edited."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from persist_cli.api.actions import Action
from persist_cli.api.cameras import Cameras
from persist_cli.api.cell_rays import first_surfaces, sheet_cells
from persist_cli.api.cells import SOLID, Box, CellForm, CellGrid, CellOrigin, numbers_at
from persist_cli.api.encoder import Encoder
from persist_cli.api.geometry import camera_rays
from persist_cli.api.ground import Body, ground_axes
from persist_cli.api.memory import FrameOfReference, MapPoints, Memory, MemoryFigures
from persist_cli.api.observations import Observations, Origin, check_observations
from persist_cli.api.scene import Scene
from persist_cli.api.scene_edits import Edit, EditOutcome
from persist_cli.api.stages import Stage
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import CheckpointError, DataError
from persist_memory.batched_reads import distinct_cameras, same_size
from persist_memory.encoders.classes import Classes
from persist_memory.grid.storage import check_within_grid
from persist_memory.scene.cell_store import CellStore, check_cells
from persist_memory.scene.editing import edit_grid
from persist_memory.scene.fusion import votes_of
from persist_memory.scene.imagination import (
    VIEW,
    Carried,
    Imagination,
    View,
    evolved,
    imagine_hidden,
    read_view,
    sees_unknown,
    windows_over,
)
from persist_memory.scene.interaction import LOAD, Load, Reached, changed_cells, reached_box, read_load
from persist_memory.scene.settings import GridSceneSettings
from persist_memory.validation import check_mergeable, with_finite_depth

MOST_FORESEEN = 10_000  # cameras that are kept of those that see nothing unknown


class GridScene(Scene):
    """A dense grid of cells that grows, with the votes of observed frames, the newest view and what is carried.

    Frames with depth say which cells are free and which hold a surface, in which colour; see ``fusion``. What they say
    does not depend on their order, and only the newest view does. An observed surface is ``solid`` until a model says
    more; then its class is imagined, its place and colour are observed. Frames that were imagined change nothing unless
    ``writes_imagined`` is set; then they fill unknown cells.

    A read casts rays into the grid. The first surface along each ray comes first, then the next ones; in each layer
    frame by frame and row by row; a ray without a surface gives no token. A token lies where its ray meets the surface.
    """

    settings_type = GridSceneSettings
    changeable = frozenset(("model", "steps", "seed", "foresight"))
    settings: GridSceneSettings
    encoder: Classes

    def __init__(self, settings: GridSceneSettings, encoder: Encoder, reference: FrameOfReference) -> None:
        super().__init__(settings, encoder, reference)
        if not isinstance(encoder, Classes):
            raise CheckpointError(
                f"memory {self.name!r} has classes, no features of images; take the encoder classes, not {encoder.name}"
            )
        if len(settings.palette) > encoder.channels:
            raise CheckpointError(
                f"memory {self.name!r} has {len(settings.palette)} classes, the encoder {encoder.channels} channels; "
                f"take encoder.classes={len(settings.palette)}"
            )
        self._form = CellForm(settings.size, tuple(settings.palette))
        self._axes = ground_axes(reference.world_up)
        self._view: View | None = None
        self._load: Load | None = None
        self._store = self._empty_store()
        self._cells: CellGrid | None = None
        self._foreseen: set[bytes] = set()  # cameras that see nothing unknown of these cells

    @property
    def cells(self) -> CellGrid:
        """All cells, in the smallest box that holds the known ones; another object after each change."""
        if self._cells is None:
            self._cells = self._store.known()
        return self._cells

    @property
    def wanted_model(self) -> str | None:
        """The setting ``model``."""
        return self.settings.model

    @property
    def wanted_stage(self) -> Stage:
        """``scene-outcome`` where the model says what interactions change."""
        return "scene-outcome" if self.settings.evolution == "model" else "scene"

    @property
    def floor(self) -> int:
        """The number of the floor's level."""
        return round(self.settings.floor / self.settings.size)

    def write(self, observations: Observations) -> None:
        """Fuse posed depth frames; pixels without depth say nothing.

        Raises:
            DataError: when a pose is not finite and rigid, a camera lies beyond the grid, or the scene would become
                too large; then nothing is written.
        """
        check_observations(observations, f"memory {self.name!r}")
        check_within_grid(observations.cameras, self._axes, self.settings.size, f"memory {self.name!r}")
        for origin, frames in with_finite_depth(observations).by_origin() if len(observations) else ():
            if origin == Origin.IMAGINED and not self.settings.writes_imagined:
                continue
            votes = votes_of(frames, self._axes, self.settings.size, self.settings.farthest)
            if not len(self._store.box.classes):
                self._store = self._empty_store(frames.depth.device)
            if origin == Origin.OBSERVED:
                self._store.observe(votes)
                self._view = View(frames.rgb[-1].clone(), frames.depth[-1].float().clone(), frames.cameras[-1])
            else:
                imagined = self._empty_store(frames.depth.device)
                imagined.observe(votes)
                self._fill(replace(imagined.box, origins=imagined.box.known.byte() * int(CellOrigin.IMAGINED)))
            self._changed()

    def add(self, cells: CellGrid) -> None:
        """Add the known cells of a grid, by the rule of origins; of equal origins the added one stays.

        Raises:
            DataError: when their size, palette or axes are not those of this scene, or the scene would become too
                large; then nothing is added.
        """
        form = cells.form
        if form != self._form:
            raise DataError(
                f"memory {self.name!r}: cells of {form.size:g} m and the classes {', '.join(form.palette)} do not fit "
                f"this scene of {self._form.size:g} m and {', '.join(self._form.palette)}"
            )
        if not torch.allclose(cells.axes.cpu(), self._axes, atol=1e-6):
            raise DataError(f"memory {self.name!r}: the axes of the cells are not those of this scene; up differs")
        self._store.put(cells)
        self._changed()

    def foresee(self, cameras: Sequence[Cameras]) -> None:
        """Imagine what camera paths will see of unknown cells, up to ``foresight``, if this scene has a model.

        Wherever a camera sees an unknown cell, all of the window around that camera is imagined. The same state, paths
        and setting ``seed`` give the same.
        """
        if self.imagines and self.settings.foresight:
            for path in cameras:
                self._foresee(path.to("cpu"))

    def read(self, cameras: Cameras, budget: int) -> MemoryTokens:
        """Return at most ``budget`` surfaces, the first along each ray first."""
        return self.read_batch([cameras], budget)[0]

    def read_batch(self, cameras: Sequence[Cameras], budget: int) -> list[MemoryTokens]:
        """Return for each camera path what ``read`` gives it; each distinct camera casts its rays once."""
        paths = [path.to(self._store.device) for path in cameras]
        strides = {self._stride(path, budget) for path in paths}
        if not same_size(paths) or len(strides) > 1:
            return [self.read_batch([path], budget)[0] for path in paths]
        distinct, groups = distinct_cameras(paths)
        stride = strides.pop()
        views = distinct.resized(max(1, distinct.height // stride), max(1, distinct.width // stride))
        grid = self.cells
        opaque = grid.solid if self.settings.unknown == "clear" else grid.solid | ~grid.known
        surfaces = first_surfaces(grid, views, self.settings.layers, opaque, sheet_cells(grid, self.floor))
        rays = torch.einsum("fij,fhwj->fhwi", views.world_from_camera.double()[:, :3, :3], camera_rays(views))
        tokens, seen = [], surfaces.known(grid)
        for group in groups:
            depth, cells = surfaces.depth[:, group], surfaces.cells[:, group]
            layer, frame, row, column = seen[:, group].nonzero()[:budget].unbind(1)
            camera = group[frame]
            along = depth[layer, frame, row, column][:, None]
            positions = views.centers[camera].double() + along * rays[camera, row, column]
            tokens.append(self._tokens(grid, cells[layer, frame, row, column], positions))
        return tokens

    def complete(self, region: Box | None = None, seed: int = 0) -> int:
        """Imagine the unknown cells of a region; see ``Scene.complete``.

        Without a region it is the model's window around the newest observed camera. Of a larger region than a window
        the parts nearest to that camera come first. Cells below the floor and above the windows stay unknown.

        Raises:
            CheckpointError: when this scene has no model, or the model knows other cells.
            DataError: when there is neither a region nor an observed frame, or the scene would become too large.
        """
        imagination = self._imagination()
        if region is None and self._view is None:
            raise DataError(
                f"memory {self.name!r}: nothing is observed yet; name a region to complete, or write a frame"
            )
        if self._view is None:
            assert region is not None
            middle = torch.tensor([region.low, region.high], dtype=torch.float64).mean(0)
        else:
            middle = self._view.camera.centers
        center = self._number_at(middle)
        if region is None:
            return self._imagine(imagination, imagination.around(center), seed)
        picks = torch.tensor([region.low, region.high], dtype=torch.float64)
        corners = torch.cartesian_prod(*picks.T.unbind(0)) @ self._axes.T / self.settings.size
        low, high = corners.amin(0).round().long().tolist(), corners.amax(0).round().long().tolist()
        windows = windows_over(low, [number + 1 for number in high], imagination.model.form, center)
        return sum(self._imagine(imagination, (x, y, self.floor), seed, region) for x, y in windows)

    def act(self, action: Action, world_from_camera: Float[Tensor, "4 4"], body: Body) -> bool:
        """Let the scene evolve by an interaction; steps and turns change nothing and are always allowed.

        Whether a step is blocked is decided where the agent's ground map is, from the points of this scene and from
        what the agent saw: see ``Surroundings``.
        """
        if not action.interaction:
            return True
        pose = world_from_camera.cpu()
        if self.settings.evolution == "model":
            return self._act_by_model(action, pose)
        before = reached_box(self.cells, pose)
        reached = Reached(before.copy(), pose, body, self.settings.carries)
        load = self._load
        if action.name == "pick_up":
            load = None if load is not None else reached.pick_up()
            done = load is not None
        elif action.name == "drop":
            done, load = load is not None and reached.drop(load), None
        else:
            done = action.name == "toggle" and reached.toggle(self.settings.toggles)
        if done:
            self._load = load
            self._change(reached.grid, before)
        return done

    def edit(self, edits: Sequence[Edit], seed: int = 0) -> EditOutcome:
        """Change cells by hand; see ``Scene.edit``."""
        before = self.cells.box(self.cells.corner, self.cells.shape)
        imagine = None
        if self.imagines:

            def imagine(grid: CellGrid, hidden: Bool[Tensor, "first second level"]) -> CellGrid:
                return imagine_hidden(self._imagination(), grid, hidden, seed)

        after, outcome = edit_grid(before, edits, imagine)
        self._change(after, before)
        return outcome

    def copy(self) -> Self:
        """Return a scene of the same cells, with the same model; changing one of the two does not change the other."""
        copy = type(self)(self.settings, self.encoder, self.reference)
        copy._store, copy._cells, copy._foreseen = self._store.copy(), self._cells, self._foreseen
        copy._view, copy._load, copy._open_model = self._view, self._load, self._open_model
        return copy

    def tensors(self) -> dict[str, Tensor]:
        """Return the known cells with their votes, in the order of their numbers, the newest view and the load."""
        parts = [part.tensors() for part in (self._view, self._load) if part is not None]
        return self._store.tensors() | {name: tensor for part in parts for name, tensor in part.items()}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Replace the content by what ``tensors()`` gave.

        Raises:
            CheckpointError: when they are not tensors of a scene with these classes; then it stays as it was.
        """
        where = f"memory {self.name!r}"
        view, load = read_view(tensors, where), read_load(tensors, len(self._form.palette), where)
        cells = {name: tensor for name, tensor in tensors.items() if name not in VIEW and name not in LOAD}
        store = self._empty_store(next(iter(cells.values())).device if cells else None)
        if cells:
            check_cells(cells, len(self._form.palette), where)
            store.fill(cells)
        self._store, self._view, self._load = store, view, load
        self._changed()

    def merge(self, other: Memory) -> None:
        """Add the cells of another scene: observed ones as if its frames had been written here.

        Of other cells the higher origin stays, and of equal ones the own; so do the own view and what is carried here.
        Model, steps, seed and foresight may differ, and the own ones stay.

        Raises:
            CheckpointError: when the two differ in another setting, such as the size of cells, or the place.
        """
        check_mergeable(self, other)
        if not isinstance(other, GridScene):
            return
        try:
            self._store.merge(other._store)
        except DataError as error:
            raise CheckpointError(str(error)) from error
        self._view, self._load = self._view or other._view, self._load or other._load
        self._changed()

    def points(self) -> MapPoints:
        """Return the middles of solid cells in their colours, with their ``CellOrigin``."""
        grid = self.cells
        places = grid.solid.nonzero()
        numbers = (places + places.new_tensor(grid.corner)).double()
        at = tuple(places.T)
        positions = (numbers * grid.form.size) @ grid.axes.to(numbers.device)
        return MapPoints(positions, grid.colors[at], grid.form.size, grid.origins[at], grid.form.size)

    def figures(self) -> MemoryFigures:
        """Return the number of known cells, their bytes, the box around them, and how many were imagined."""
        grid, tensors = self.cells, self.tensors()
        size = sum(tensor.numel() * tensor.element_size() for tensor in tensors.values())
        known = int(grid.known.sum())
        if not known:
            return MemoryFigures(0, size, None)
        ends = torch.tensor([grid.corner, [a + b for a, b in zip(grid.corner, grid.shape, strict=True)]])
        corners = torch.cartesian_prod(*(ends.double() - 0.5).T.unbind(0)) * grid.form.size @ self._axes
        bounds = tuple(corners.amin(0).tolist()), tuple(corners.amax(0).tolist())
        return MemoryFigures(known, size, bounds, int((grid.origins == CellOrigin.IMAGINED).sum()))

    def resolution(self, cameras: Cameras, distance: float = 2.5) -> float:
        """Return the edge of a cell."""
        return self.settings.size

    def _empty_store(self, device: torch.device | None = None) -> CellStore:
        empty = CellGrid.unknown((0, 0, 0), (0, 0, 0), self._form, self._axes)
        return CellStore(empty if device is None else empty.to(device))

    def _number_at(self, position: Float[Tensor, " 3"]) -> list[int]:
        """The number of the cell at a place in world metres."""
        numbers: list[int] = numbers_at(self._axes @ position.cpu().double() / self.settings.size).tolist()
        return numbers

    def _stride(self, path: Cameras, budget: int) -> int:
        """The pixels from ray to ray with which the first surfaces of a path fit into a budget."""
        stride = self.settings.stride
        while len(path) * (path.height // stride) * (path.width // stride) > max(1, budget) and stride < path.height:
            stride += 1
        return stride

    def _tokens(self, grid: CellGrid, cells: Tensor, positions: Float[Tensor, "token 3"]) -> MemoryTokens:
        """The tokens of surfaces."""
        origins = grid.origins.flatten()[cells].clamp_max(int(Origin.OBSERVED))  # an edit is a fact, as observed
        features = self.encoder.features(grid.classes.flatten()[cells])
        return MemoryTokens.of(features, positions, grid.colors.flatten(0, 2)[cells], origins)

    def _imagination(self) -> Imagination:
        """What imagines now, after a check that it knows such cells."""
        load = self._load
        carried = Carried(0, torch.zeros(3, dtype=torch.uint8)) if load is None else Carried(load.kind, load.color)
        imagination = Imagination(self.model(), self.settings.steps, self._view, self.floor, carried)
        imagination.check(self._store.box)
        return imagination

    def _imagine(
        self, imagination: Imagination, corner: tuple[int, int, int], seed: int, region: Box | None = None
    ) -> int:
        """Imagine the unknown cells of a window, those in a region alone, and return how many.

        Where none is unknown, but the class of a solid one is, the model still says which class it has.
        """
        window = self._store.box.box(corner, imagination.model.form.shape)
        wanted = torch.ones_like(window.known) if region is None else region.contains(window.centers())
        unnamed, chosen = wanted & window.known & (window.classes == SOLID), wanted & ~window.known
        if bool((chosen | unnamed).any()):
            filled = imagination.fill(window, seed)
            self._store.reach(corner, [a + b for a, b in zip(corner, window.shape, strict=True)])
            self._store.replace(filled, chosen)
            self._store.name(filled, unnamed & (filled.classes != SOLID))
            self._changed()
        return int(chosen.sum())

    def _changed(self) -> None:
        """Forget what was found out about the cells before."""
        self._cells, self._foreseen = None, set()  # another set, for copies may keep theirs

    def _foresee(self, path: Cameras) -> None:
        """Imagine windows around the cameras of a path until none sees an unknown cell."""
        imagination = self._imagination()
        _, [places] = distinct_cameras([path])
        for number, place in enumerate(places.tolist()):
            camera = path[number : number + 1]
            if place in places[:number] or _key(camera) in self._foreseen:  # a clip repeats its last camera
                continue
            corner = imagination.around(self._number_at(camera.centers[0]))
            window = self._store.box.box(corner, imagination.model.form.shape)
            if sees_unknown(window, camera, self.settings.foresight, self.floor):
                self._imagine(imagination, corner, self.settings.seed)
            elif len(self._foreseen) < MOST_FORESEEN:
                self._foreseen.add(_key(camera))

    def _act_by_model(self, action: Action, pose: Float[Tensor, "4 4"]) -> bool:
        """Let the scene model say what becomes of the cells in reach; false when it changes nothing."""
        if (action.name == "pick_up" and self._load is not None) or (action.name == "drop" and self._load is None):
            return False  # the hands are full, or empty: no matter what a model would say
        imagination = self._imagination()
        center = self._number_at(pose[:3, 3])
        before = self._store.box.box(imagination.around(center), imagination.model.form.shape)
        after = evolved(imagination, before, action.name, pose, self.settings.seed)
        if after is None:
            return False
        if action.name == "pick_up":
            gone = (before.solid & ~after.solid).nonzero()
            self._load = Load.taken(before, gone) if len(gone) else None
        elif action.name == "drop":
            self._load = None
        self._change(after, before)
        return True

    def _change(self, after: CellGrid, before: CellGrid) -> None:
        """Overwrite the cells in which two grids of one box differ; the view no longer shows what is gone."""
        gone = before.solid & ~after.solid
        if self._view is not None and bool(gone.any()):
            self._view = self._view.without(before, gone)
        self._store.replace(after, changed_cells(before, after))
        self._changed()

    def _fill(self, cells: CellGrid) -> None:
        """Take over the known cells of a grid where nothing is known."""
        unknown = cells.known & ~self._store.box.box(cells.corner, cells.shape).known.to(cells.classes.device)
        self._store.replace(cells, unknown)


def _key(camera: Cameras) -> bytes:
    """A camera in bytes, of which another camera has others."""
    parts = (camera.world_from_camera.double(), camera.intrinsics.double(), torch.tensor([camera.height, camera.width]))
    return b"".join(part.numpy().tobytes() for part in parts)
