"""Views of a scene before and after an edit: its cells drawn by rays, and what a world model imagines there."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.cell_rays import first_surfaces
from persist_cli.api.cells import CellGrid
from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.api.geometry import unproject
from persist_cli.api.inference import SamplingOverrides
from persist_cli.api.memory import FrameOfReference, Memory
from persist_cli.data.clips import interactions_of
from persist_cli.data.reference import Reference, parse_reference
from persist_cli.data.store import TrajectoryFile
from persist_cli.editing.locality import edited_pixels, flat_cells
from persist_cli.errors import DataError
from persist_cli.io.files import written_aside
from persist_cli.output.console import busy
from persist_cli.output.video import below, beside, enlarge, labelled
from persist_cli.rollout.open_world import WorldOptions, assemble_world

SIDE: Final = 256  # pixels of the shorter side of a drawn view
FIELD: Final = 75.0  # degrees of a view along a path of a memory file, which keeps no intrinsics
SEARCHED: Final = 48  # poses of these paths among which the one that sees the edit best is sought
COARSE: Final = 24  # pixels of the side of a view while it is sought
BACKGROUND: Final = 235  # grey where a ray meets nothing
SHADES: Final = (0.8, 0.9, 1.0)  # of faces along the two ground axes, and of floors and tops

Pictures = UInt8[Tensor, "frame height width 3"]


@dataclass(frozen=True)
class View:
    """A place from which an edit is looked at.

    Args:
        cameras: the camera, with a frame axis of one.
        name: where it comes from, for people.
    """

    cameras: Cameras
    name: str


@dataclass(frozen=True)
class ViewPair:
    """Pictures of one camera before and after an edit.

    Args:
        title: what draws them.
        before: the picture before, with a frame axis of one.
        after: the picture after it.
        cameras: the camera, of the pictures' size.
    """

    title: str
    before: Pictures
    after: Pictures
    cameras: Cameras


def view_of_data(text: str, reference: FrameOfReference) -> View:
    """Return the camera of a frame ``DATA#trajectory:frame``, or of the last of several frames.

    Raises:
        DataError: when there is no such frame, or it is of another scene.
    """
    file, frames = frames_of(parse_reference(text), text)
    if file.info.scene != reference.name:
        raise DataError(f"--camera {text}: is of scene {file.info.scene!r}, the memory of {reference.name!r}")
    return View(file.read([frames.stop - 1]).observations.cameras, f"{text.partition(':')[0]}:{frames.stop - 1}")


def frames_of(reference: Reference, text: str) -> tuple[TrajectoryFile, range]:
    """Return the trajectory and the frames of a camera's reference."""
    file = reference.single()
    first, stop = (0, 1) if reference.frames is None else (reference.frames.start, reference.frames.stop)
    if stop > file.length:
        raise DataError(f"--camera {text}: {file.path} has {file.length} frames (0-{file.length - 1}) only")
    return file, range(first, stop)


def view_of_paths(paths: Mapping[str, Float[Tensor, "frame 4 4"]], before: CellGrid, after: CellGrid) -> View | None:
    """Return the camera on the paths of a memory file that sees most of an edit, the newest of equal ones.

    The file keeps no intrinsics, so that it looks 75 degrees wide. Without paths there is none.
    """
    places = [(name, frame, pose) for name, poses in paths.items() for frame, pose in enumerate(poses.double())]
    if not places:
        return None
    numbers = torch.linspace(0, len(places) - 1, min(len(places), SEARCHED)).round().long().unique().tolist()
    chosen = [places[number] for number in numbers]
    seen = edited_pixels(before, after, path_cameras([pose for *_, pose in chosen], COARSE)).flatten(1).sum(1)
    best = max(range(len(chosen)), key=lambda number: (int(seen[number]), number))
    name, frame, pose = chosen[best]
    return View(path_cameras([pose], SIDE), f"frame {frame} of path {name!r}")


def path_cameras(poses: Sequence[Float[Tensor, "4 4"]], side: int) -> Cameras:
    """Return square cameras of ``side`` pixels at poses of a path whose intrinsics are not known: 75 degrees wide."""
    focal = side / 2 / math.tan(math.radians(FIELD) / 2)
    matrix = torch.tensor([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1]], dtype=torch.float64)
    return Cameras(torch.stack(list(poses)), matrix.expand(len(poses), 3, 3), side, side)


def drawn_cells(grid: CellGrid, cameras: Cameras) -> Pictures:
    """Return pictures of the cells as cameras see them: each face in its cell's colour, shaded by its direction."""
    surfaces = first_surfaces(grid, cameras, sheets=flat_cells(grid))
    depth = torch.where(surfaces.hit[0], surfaces.depth[0], 0.0)
    places = (unproject(depth, cameras) @ grid.axes.T) / grid.form.size
    face = (places - places.round()).abs().argmax(dim=-1)  # the axis along which the point lies at the cell's border
    level = flat_cells(grid).flatten()[surfaces.cells[0].clamp(min=0)]
    shade = torch.tensor(SHADES)[torch.where(level, 2, face)]
    colors = surfaces.colors(grid)[0].float() * shade[..., None]
    return torch.where(surfaces.hit[0][..., None], colors, float(BACKGROUND)).round().to(torch.uint8)


def cells_before_and_after(before: CellGrid, after: CellGrid, view: View) -> ViewPair:
    """Return pictures of the cells from a view, large enough to be looked at."""
    scale = SIDE / min(view.cameras.height, view.cameras.width)
    cameras = view.cameras.resized(round(view.cameras.height * scale), round(view.cameras.width * scale))
    return ViewPair("cells", drawn_cells(before, cameras), drawn_cells(after, cameras), cameras)


@dataclass(frozen=True)
class Imagination:
    """What a world model needs to imagine a view.

    Args:
        checkpoint: a run, a checkpoint or ``reference``.
        adapter: name of its memory adapter; ``None`` for its default or only one.
        sampling: steps, sampler and guidance in place of the checkpoint's own.
        seed: of the sampling noise.
    """

    checkpoint: Path
    adapter: str | None
    sampling: SamplingOverrides
    seed: int


def imagined_before_and_after(imagination: Imagination, text: str, file: Path, edited: Memory) -> ViewPair:
    """Return the last frame of a clip, as a world model imagines it with the memory of a file and with its edited one.

    Both clips begin at the same true frame and have the same noise. The clip ends at the camera: it goes along the
    frames that are named, or along as many before a single one as a clip has.

    Args:
        imagination: the world model.
        text: the frames, as in ``DATA#trajectory:20-28``.
        file: the memory before the edit.
        edited: the memory after it.

    Raises:
        PersistError: when model, memory and data do not go together.
    """
    source, frames = frames_of(parse_reference(text), text)
    options = WorldOptions(
        start=text, memory=file, adapter=imagination.adapter, write=False, seed=imagination.seed,
        sampling=imagination.sampling, body=False,
    )  # fmt: skip
    checkpoint = find_checkpoint(imagination.checkpoint)
    world = assemble_world(checkpoint, checkpoint.chosen_adapter(imagination.adapter), options, source.info)
    if len(frames) == 1:
        frames = range(max(0, frames.start - world.clip_frames + 1), frames.stop)
    if len(frames) < 2:
        raise DataError(f"--camera {text}: no frame leads to the first one; name a later one, or several as in :0-9")
    part, pictures = source.read(slice(frames.start, frames.stop)), []
    agent = world.agents[0]
    for memory in (agent.memory, edited.copy().placed(world.backbone.device)):  # a scene imagines what it is read for
        agent.memory = memory
        world.reset([part.observations[:1]], [part.info])
        ways = [part.observations.cameras[1:]], [interactions_of(part.actions[:-1], part.info.vocabulary)]
        with busy("imagining the view"):
            clips = [seen for [seen] in world.imagine(*ways)]
        pictures.append(clips[-1].rgb[-1:])
    return ViewPair("imagined", pictures[0], pictures[1], part.observations.cameras[-1:])


def write_views(path: Path, pairs: Sequence[ViewPair]) -> None:
    """Write a PNG with a row for each pair of pictures, before on the left and after on the right."""
    width = max(enlarge(pair.before).shape[2] for pair in pairs)
    rows = []
    for pair in pairs:
        pictures = [(enlarge(pair.before), f"before, {pair.title}"), (enlarge(pair.after), f"after, {pair.title}")]
        rows.append(beside([_padded(labelled(picture, title), width) for picture, title in pictures]))
    with written_aside(path) as aside:
        Image.fromarray(below(rows)[0].numpy()).save(aside, format="PNG")


def _padded(picture: Pictures, width: int) -> Pictures:
    return torch.nn.functional.pad(picture, (0, 0, 0, width - picture.shape[2]), value=255)
