"""7-Scenes: ``frame-NNNNNN.{color.jpg|color.png,depth.png,pose.txt}`` and ``camera-intrinsics.txt``.

Poses are OpenCV ``world_from_camera`` in metres already. The intrinsics count pixels from the centre of the
top-left one, as tsdf-fusion does with these files, so the principal point moves by half a pixel to become ours.
Colour and depth of this Kinect were not registered to each other: colours lie some pixels beside their depth.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator
from pathlib import Path

from persist_cli.api.importer import ForeignTrajectory, Importer
from persist_cli.data.importers.captures import (
    Capture,
    CapturedFrame,
    each_or_cause,
    given_up,
    numbered,
    read_pose,
    world_up_of,
)
from persist_cli.data.importers.lenses import Lens
from persist_cli.data.importers.readers import INTRINSICS, color_file, depth_file, read_lens
from persist_cli.errors import DataError

FRAME = re.compile(r"^(?P<stem>frame-\d+)\.(?P<part>color\.jpg|color\.png|depth\.png|pose\.txt)$")
SEQUENCE = re.compile(r"^seq-?\d+$")
MISSING = (0, 65535)  # raw values without depth, which is in millimetres
FRAMES_PER_SECOND = 30.0


class SevenScenes(Importer):
    """The importer of one sequence, or of a scene whose ``seq-*`` folders are its trajectories."""

    def trajectories(self, source: Path) -> Iterator[ForeignTrajectory | DataError]:
        """Read every sequence of ``source`` as a trajectory named after its scene.

        Raises:
            DataError: when there is none.
        """
        source = Path(os.path.abspath(source))  # a link keeps its own name
        if not source.is_dir():
            raise DataError(f"{source}: no such folder")
        folders = [source] if any(source.glob("frame-*")) else _sequence_folders(source)
        if not folders:
            raise DataError(f"{source}: neither frame-*.color files nor seq-* folders in it")
        up = given_up(self)

        def trajectory(folder: Path) -> ForeignTrajectory:
            nonlocal up
            sequence = read_sequence(folder)
            up = up or world_up_of(_of_one_world(folder, sequence))
            return sequence.trajectory(up)

        return each_or_cause(folders, trajectory)


def read_sequence(folder: Path) -> Capture:
    """A sequence with all its poses.

    Raises:
        DataError: when there is no frame, no pose that can be used, or no matrix of the camera.
    """
    files = _frame_files(folder)
    poses, lens, first = [read_pose(paths["pose"]) for _, paths in files], _lens(folder), files[0][0]
    is_part = bool(SEQUENCE.match(folder.name))
    return Capture(
        folder=folder,
        scene=folder.parent.name if is_part else folder.name,
        part=folder.name if is_part else "",
        frames=[
            CapturedFrame(
                color_file(paths["color"]),
                depth_file(paths["depth"], missing=MISSING),
                pose,
                lens,
                seconds=(number - first) / FRAMES_PER_SECOND,
            )
            for (number, paths), pose in zip(files, poses, strict=True)
        ],
        files=[path for _, paths in files for path in paths.values()],
        source={"format": "7scenes"},
    )


def _sequence_folders(scene: Path) -> list[Path]:
    """The ``seq-*`` folders of a scene in the order of their numbers."""
    folders = [path for path in scene.iterdir() if path.is_dir() and SEQUENCE.match(path.name)]
    return sorted(folders, key=lambda folder: numbered(folder.name))


def _of_one_world(folder: Path, sequence: Capture) -> list[Capture]:
    """All sequences that share the world of one, whichever of them are imported; none that cannot be read."""
    sequences = []
    for other in _sequence_folders(folder.parent) if sequence.part else [folder]:
        with contextlib.suppress(DataError):  # it is reported when its turn comes
            sequences.append(sequence if other == folder else read_sequence(other))
    return sequences


def _frame_files(folder: Path) -> list[tuple[int, dict[str, Path]]]:
    """The number of every frame with its colour, depth and pose, in order; where one is missing, where it should be."""
    found: dict[str, dict[str, Path]] = {}
    for path in sorted(folder.iterdir()):
        match = FRAME.match(path.name)
        if match:
            found.setdefault(match["stem"], {})[match["part"].partition(".")[0]] = path
    if not found:
        raise DataError(f"{folder}: no frame-NNNNNN.color.png or .jpg files in it")
    suffixes = {"color": "png", "depth": "png", "pose": "txt"}
    return [
        (
            int(stem.removeprefix("frame-")),
            {part: found[stem].get(part, folder / f"{stem}.{part}.{suffix}") for part, suffix in suffixes.items()},
        )
        for stem in sorted(found, key=numbered)
    ]


def _lens(folder: Path) -> Lens:
    """The lens by the matrix in or above ``folder``."""
    candidates = [folder / INTRINSICS, folder.parent / INTRINSICS]
    path = next((candidate for candidate in candidates if candidate.is_file()), None)
    if path is None:
        raise DataError(
            f"{candidates[0]}: no such file; write the 3×3 matrix there (7-Scenes: 585 0 320 0 585 240 0 0 1)"
        )
    return read_lens(path, 3)
