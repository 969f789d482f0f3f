"""What ``persist view`` shows: a trajectory of a data set, a memory file, or the folder of a rollout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from persist_cli.api.cameras import Cameras, check_poses
from persist_cli.api.memory import Memory
from persist_cli.api.memory_file import is_memory_file
from persist_cli.api.observations import Observations, Origin
from persist_cli.data.reference import Reference, parse_reference
from persist_cli.data.store import TrajectoryFile
from persist_cli.editing.views import path_cameras
from persist_cli.errors import DataError, PersistError
from persist_cli.io.files import read_json
from persist_cli.memorize.memory_file import load_memory, load_paths
from persist_cli.output.video import read_video
from persist_cli.viewer.drawn_cells import DrawnCells, cells_of_frames, cells_of_grid, cells_of_memory

MOST_FRAMES: Final = 240  # of a walk that are read; of a longer one evenly chosen ones
MOST_PIXELS: Final = 128  # of the shorter side of depth that becomes points, and of pictures
PATH_PIXELS: Final = 64  # of the side of a camera whose intrinsics are not known
MAP, POINTS, SCENE, TRUTH = "map", "points", "true cells", "truth"  # names of what is drawn


@dataclass(frozen=True)
class DrawnWalk:
    """A camera's way, with what it saw where that is known.

    Args:
        name: for people.
        cameras: the camera of each frame.
        numbers: the number of each frame in its source.
        pictures: uint8 RGB, 0…255; ``None`` where there are none.
        depth: planar z in metres, 0 = missing; ``None`` where there is none.
        origin: whether the frames were observed or imagined.
        is_truth: whether these are true frames beside imagined ones.
    """

    name: str
    cameras: Cameras
    numbers: tuple[int, ...]
    pictures: UInt8[Tensor, "frame height width 3"] | None = None
    depth: Float[Tensor, "frame height width"] | None = None
    origin: Origin = Origin.OBSERVED
    is_truth: bool = False

    def __len__(self) -> int:
        return len(self.cameras)


@dataclass(frozen=True)
class Subject:
    """All that is drawn.

    Args:
        title: what the user named.
        scene: name of the frame of reference.
        world_up: unit vector that points up in the world.
        walks: the cameras' ways; of one length where truth stands beside imagined frames.
        layers: blocks by name, the first one is shown at first; that of the memory is ``MAP``.
        memory: the memory, ``None`` without one.
        file: the memory's file.
        start: the trajectory from whose frames a world model can begin, ``None`` where none is known.
        notices: lines that say what is left out.
    """

    title: str
    scene: str
    world_up: tuple[float, float, float]
    walks: tuple[DrawnWalk, ...]
    layers: dict[str, DrawnCells]
    memory: Memory | None = None
    file: Path | None = None
    start: TrajectoryFile | None = None
    notices: tuple[str, ...] = ()


def open_subject(text: str, truth: str | None = None, start: str | None = None) -> Subject:
    """Return what a command line names.

    Args:
        text: ``DATA#trajectory``, also with frames, a memory file, or the folder of a rollout.
        truth: frames of a data set that are shown beside it.
        start: trajectory from whose frames a world model may begin; by default the one that is shown.

    Raises:
        PersistError: one line when one of them is missing or damaged, or they are of different scenes.
    """
    place = Path(text)
    if place.is_dir() and ((place / "rollout.json").exists() or list(place.glob("*/rollout.json"))):
        subject = _of_rollout(place)
    elif is_memory_file(text):
        subject = _of_memory(place)
    else:
        subject = _of_trajectory(text)
    if truth is not None:
        subject = _with_truth(subject, parse_reference(truth), f"--truth {truth}")
    if start is not None:
        file = parse_reference(start).single()
        _check_scene(subject, file, f"--start {start}")
        subject = replace(subject, start=file)
    return subject


def _of_memory(path: Path) -> Subject:
    memory, paths = load_memory(path), load_paths(path)
    walks = []
    for name, poses in paths.items():
        numbers, _ = _chosen(range(len(poses)), name)
        if numbers:
            cameras = path_cameras([*poses[numbers].double()], PATH_PIXELS)
            walks.append(DrawnWalk(name, cameras, tuple(numbers)))
    walks += _stored_frames(memory)
    reference, layers = memory.reference, {MAP: cells_of_memory(memory)}
    notices = () if walks else ("the file keeps no path, so no camera is drawn",)
    return Subject(str(path), reference.name, reference.world_up, (*walks,), layers, memory, path, None, notices)


def _stored_frames(memory: Memory) -> list[DrawnWalk]:
    """Return the images that a memory of images stores, with their cameras; none of another kind of memory."""
    tensors = memory.tensors()
    if not {"images", "world_from_camera", "intrinsics"} <= set(tensors) or not len(tensors["images"]):
        return []
    images = tensors["images"]
    cameras = Cameras(tensors["world_from_camera"], tensors["intrinsics"], images.shape[1], images.shape[2])
    return [DrawnWalk(f"images of memory {memory.name}", cameras, tuple(range(len(images))), images)]


def _of_trajectory(text: str) -> Subject:
    file, walk, notices = _read_walk(parse_reference(text), "walk")
    return Subject(
        text, file.info.scene, file.info.world_up, (walk,), _layers_of(file, walk), start=file, notices=notices
    )


def _layers_of(file: TrajectoryFile, walk: DrawnWalk) -> dict[str, DrawnCells]:
    """Return what the frames of a walk saw, and the scene's own cells where they are stored."""
    assert walk.pictures is not None
    assert walk.depth is not None
    seen = Observations(walk.pictures, walk.depth, walk.cameras)
    layers = {POINTS: cells_of_frames(seen, file.info.world_up)}
    if file.has_cells:
        layers[SCENE] = cells_of_grid(file.cells(walk.numbers[-1]))
    return layers


def _of_rollout(folder: Path) -> Subject:
    """Return the imagined frames of a rollout with its memory, and the true frames if it followed a trajectory."""
    if not (folder / "rollout.json").is_file():
        branches = sorted(path.parent for path in folder.glob("*/rollout.json"))
        raise DataError(f"{folder}: holds {len(branches)} branches of a rollout; name one, as in {branches[0]}")
    values = read_json(folder / "rollout.json", DataError)
    plan = values.get("plan") if isinstance(values, dict) else None
    if not isinstance(plan, dict) or not isinstance(plan.get("start"), str):
        raise DataError(f"{folder / 'rollout.json'}: names no start frame; `persist rollout` writes it")
    reference = parse_reference(plan["start"])
    try:
        file = reference.single()
        first, info = reference.frame, file.info
    except PersistError as error:
        raise DataError(f"{folder}: its start frame is gone ({error}); put the data back there") from error
    poses = read_poses(folder / "poses.txt")
    rgb = read_video(folder / "rgb.mp4", info.height, info.width)
    if len(rgb) != len(poses):
        raise DataError(f"{folder}: rgb.mp4 has {len(rgb)} frames, poses.txt {len(poses)}; roll out anew")
    cameras = file.cameras([first]).at(poses)
    numbers, notices = _chosen(range(len(poses)), "the rollout")
    walk = _small(DrawnWalk("imagined", cameras[numbers], tuple(numbers), rgb[numbers], origin=Origin.IMAGINED))
    memory_file = folder / "memory.safetensors"
    subject = Subject(str(folder), info.scene, info.world_up, (walk,), {}, start=file, notices=notices)
    if memory_file.is_file():
        memory = load_memory(memory_file)
        layers = {MAP: cells_of_memory(memory)}
        subject = replace(subject, layers=layers, memory=memory, file=memory_file)
    if not plan.get("follow"):
        return subject
    followed = replace(reference, frames=slice(first, min(first + len(poses), file.length)))
    return _with_truth(subject, followed, plan["start"])


def _with_truth(subject: Subject, reference: Reference, named: str) -> Subject:
    """Return a subject with true frames, and what they saw, beside it; ``named`` says where they were named."""
    file, walk, notices = _read_walk(reference, "truth")
    _check_scene(subject, file, named)
    walk = replace(walk, is_truth=True)
    layers = _layers_of(file, walk)
    truth = layers.get(SCENE, layers[POINTS])
    return replace(
        subject,
        walks=(*subject.walks, walk),
        layers=subject.layers | {TRUTH: truth},
        notices=subject.notices + notices,
        start=subject.start or file,
    )


def _check_scene(subject: Subject, file: TrajectoryFile, option: str) -> None:
    if file.info.scene != subject.scene:
        raise DataError(
            f"{option}: is of scene {file.info.scene!r}, {subject.title} of {subject.scene!r}; name frames of one scene"
        )


def _read_walk(reference: Reference, name: str) -> tuple[TrajectoryFile, DrawnWalk, tuple[str, ...]]:
    file = reference.single()
    numbers, notices = _chosen(file.frame_numbers(reference.frames or slice(None)), reference.text)
    part = file.read(numbers).observations
    return file, _small(DrawnWalk(name, part.cameras, tuple(numbers), part.rgb, part.depth)), notices


def _chosen(numbers: Sequence[int], name: str) -> tuple[list[int], tuple[str, ...]]:
    """Return at most ``MOST_FRAMES`` of some frames, evenly chosen, and a line that says so where some are left out."""
    if len(numbers) <= MOST_FRAMES:
        return list(numbers), ()
    picks = torch.linspace(0, len(numbers) - 1, MOST_FRAMES).round().long().tolist()
    return [numbers[pick] for pick in picks], (f"{name}: {MOST_FRAMES} of {len(numbers)} frames are shown",)


def _small(walk: DrawnWalk) -> DrawnWalk:
    """Return a walk whose images have every n-th pixel alone, so that the shorter side has at most ``MOST_PIXELS``."""
    assert walk.pictures is not None
    step = -(-min(walk.pictures.shape[1:3]) // MOST_PIXELS)
    if step == 1:
        return walk
    every = slice(step // 2, None, step)
    depth = None if walk.depth is None else walk.depth[:, every, every]
    return replace(walk, pictures=walk.pictures[:, every, every], depth=depth, cameras=walk.cameras.thinned(step))


def read_poses(path: Path) -> Float[Tensor, "frame 4 4"]:
    """Return world_from_camera of a file that ``write_poses`` wrote, lines ``t tx ty tz qx qy qz qw`` (TUM), float64.

    Raises:
        DataError: when it is missing or damaged.
    """
    try:
        rows = [line.split() for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
        values = torch.tensor([[float(value) for value in row] for row in rows], dtype=torch.float64)
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: cannot be read as poses ({error}); roll out anew") from error
    if values.ndim != 2 or values.shape[1] != 8:
        raise DataError(f"{path}: holds no lines of eight numbers; roll out anew")
    poses = torch.eye(4, dtype=torch.float64).repeat(len(values), 1, 1)
    poses[:, :3, :3], poses[:, :3, 3] = _rotations(values[:, 4:]), values[:, 1:4]
    check_poses(poses, str(path))
    return poses


def _rotations(quaternions: Float[Tensor, "frame 4"]) -> Float[Tensor, "frame 3 3"]:
    """Return the rotations of unit quaternions (qx, qy, qz, qw)."""
    x, y, z, w = torch.nn.functional.normalize(quaternions, dim=1).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def describe(subject: Subject) -> dict[str, Any]:
    """Return what is shown as values of JSON."""
    walks = [{"name": walk.name, "frames": len(walk), "origin": walk.origin.name.lower()} for walk in subject.walks]
    layers = {name: len(cells) for name, cells in subject.layers.items()}
    return {"source": subject.title, "scene": subject.scene, "walks": walks, "blocks": layers}
