"""Where a walk begins: a frame of a data set, a picture with its depth, or a place in a memory file."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path

from persist_cli.api.memory_file import is_memory_file
from persist_cli.api.observations import Trajectory
from persist_cli.data.reference import parse_reference
from persist_cli.data.store import Store
from persist_cli.errors import DataError
from persist_cli.memorize.picture import PictureOptions, is_picture, refuse_picture_options, write_picture
from persist_cli.play.memory_start import memory_start
from persist_cli.rollout.camera_path import walking_vocabulary
from persist_cli.rollout.open_world import WorldOptions

SAMPLE_START = "sample#0:32"  # where a walk begins when nothing is named
SAMPLE_FRAMES = "sample#0:0-33"  # and what is remembered there


@dataclass(frozen=True)
class StartOptions:
    """Where a walk begins, and with which actions.

    Args:
        start: ``DATA#trajectory:frame``, a picture or a memory file.
        picture: what is known of a picture beside its pixels.
        step: metres of a step, in place of the data set's own.
        turn: degrees of a turn.
        body: whether walls stop the walker; ``None``: where the height of its camera is told.
    """

    start: str = SAMPLE_START
    picture: PictureOptions = field(default_factory=PictureOptions)
    step: float | None = None
    turn: float | None = None
    body: bool | None = None

    @property
    def world(self) -> WorldOptions:
        """Those of the options that a world model is put together with."""
        return WorldOptions(start=self.start, body=self.body)


def read_start(
    options: StartOptions, image_size: tuple[int, int], fov: tuple[float, float] | None = None
) -> Trajectory:
    """Return the single frame at which a walk begins, with the actions that the keys can have.

    Args:
        options: where, and with which actions.
        image_size: height and width in pixels that the model takes; a picture is cropped and resized to it.
        fov: degrees of view that the model was trained with, which a start in a memory file gets.

    Raises:
        DataError: one line when the start is missing, damaged, or a picture without depth.
    """
    if is_picture(options.start):
        return _picture_start(options, image_size)
    refuse_picture_options(options.picture)
    if is_memory_file(options.start):
        return _with_steps(memory_start(Path(options.start), image_size, fov), options)
    if Path(options.start).is_file():
        raise DataError(f"--start {options.start}: neither a data set, a picture nor a memory file; give {_FORMS}")
    reference = parse_reference(options.start)
    file = reference.single()
    start = file.read([reference.frame])
    vocabulary = walking_vocabulary(file, options.start, options.step, options.turn)
    return replace(start, info=replace(start.info, vocabulary=vocabulary))


_FORMS = "DATA#trajectory:frame, a picture with --depth FILE, or a memory file"


def _picture_start(options: StartOptions, image_size: tuple[int, int]) -> Trajectory:
    picture = Path(options.start)
    if not picture.is_file():
        raise DataError(f"--start {picture}: no such picture; give {_FORMS}")
    height, width = image_size
    if height != width:
        raise DataError(f"--start {picture}: the model takes {height}x{width}, and pictures are made square; give data")
    with tempfile.TemporaryDirectory() as folder:
        sized = replace(options.picture, size=height)
        start = Store(write_picture(picture, sized, Path(folder)).parent)[0].read()
    return _with_steps(start, options)


def _with_steps(start: Trajectory, options: StartOptions) -> Trajectory:
    """Return a start with steps and turns of the options' size."""
    if options.step is None and options.turn is None:
        return start
    vocabulary = start.info.vocabulary.walking(options.step, options.turn)
    return replace(start, info=replace(start.info, vocabulary=vocabulary))
