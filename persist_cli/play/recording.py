"""What was walked through, kept to be saved as a video and as a data set."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import torch
from jaxtyping import UInt8
from torch import Tensor

from persist_cli.api.actions import FREE, Action, ActionVocabulary
from persist_cli.api.observations import Frame, Observations, TrajectoryInfo
from persist_cli.data.parquet import SUFFIX
from persist_cli.data.store import write_trajectory
from persist_cli.errors import PersistError
from persist_cli.io.files import check_folder
from persist_cli.navigation.ground_mapper import body_of, tells_body
from persist_cli.output.video import beside, enlarge, labelled, write_video

LONGEST: Final = 5000  # frames of a recording, ten minutes at eight a second; some 150 MB at 64×64 for each memory
RATE: Final = 8  # frames a second of the video
VIDEO: Final = "walk.mp4"
DATA: Final = "data"


@dataclass(frozen=True)
class SavedRecording:
    """The files of a recording.

    Args:
        frames: number of frames, the first one included.
        video: MP4 of all memories side by side.
        data: a data set with a trajectory for each memory, which ``rollout --follow`` and ``eval`` read.
    """

    frames: int
    video: Path
    data: Path


class Recording:
    """The frames of a walk, from one on.

    Args:
        names: of the memories.
        first: the frame of each at the beginning.
    """

    def __init__(self, names: Sequence[str], first: Sequence[Observations]) -> None:
        self.names = names
        self._frames = [_kept(first)]
        self._actions: list[str] = []

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def full(self) -> bool:
        """Whether no more frames are taken, nor any taken away."""
        return len(self) >= LONGEST

    def add(self, action: str | None, frames: Sequence[Observations]) -> None:
        """Append the frames of all memories after an action, ``None`` for a jump; nothing once it is full."""
        if not self.full:
            self._actions.append(action or FREE)
            self._frames.append(_kept(frames))

    def undo(self) -> None:
        """Take the last frame away again, if it is not the first; nothing once it is full.

        The walker may have gone on since a recording became full: what is undone then is no part of it.
        """
        if self._actions and not self.full:
            self._actions.pop()
            self._frames.pop()

    def save(self, folder: Path, info: TrajectoryInfo, source: Mapping[str, Any]) -> SavedRecording:
        """Write the video and the data set.

        Args:
            folder: is made; files in it of an earlier recording are replaced.
            info: of the world walked in.
            source: what the trajectories shall say of where they come from.

        Raises:
            PersistError: when there is but one frame.
            DataError: when the folder cannot be written.
        """
        if len(self) < 2:
            raise PersistError("nothing was walked while recording, so there is nothing to save; walk a step first")
        check_folder(folder)
        info = replace(info, vocabulary=_with_free(info.vocabulary, self._actions))
        info = replace(info, source={"format": "play", **_told_body(info), **source})
        for number, name in enumerate(self.names):
            told = replace(info, source=info.source | {"memory": name})
            write_trajectory(folder / DATA / f"{name}{SUFFIX}", told, self._walk(number))
        write_video(folder / VIDEO, map(self._picture, self._frames), RATE)
        return SavedRecording(len(self), folder / VIDEO, folder / DATA)

    def _walk(self, memory: int) -> Iterator[Frame]:
        """Give the frames of one memory with their actions and times."""
        for number, (frames, action) in enumerate(zip(self._frames, [*self._actions, None], strict=True)):
            yield replace(frames[memory], action=action, timestamp=number / RATE)

    def _picture(self, frames: Sequence[Frame]) -> UInt8[Tensor, "height width 3"]:
        """Return what the video shows of the frames of all memories."""
        views = [torch.from_numpy(frame.rgb)[None] for frame in frames]
        if len(views) > 1:
            views = [beside([labelled(enlarge(one), name) for one, name in zip(views, self.names, strict=True)])]
        return views[0][0]


def _kept(frames: Sequence[Observations]) -> tuple[Frame, ...]:
    """Return frames on the processor, without the clips that they are parts of."""
    return tuple(
        Frame(
            seen.rgb[0].cpu().numpy().copy(),
            seen.depth[0].cpu().numpy().copy(),
            seen.cameras.world_from_camera[0].cpu().double().numpy().copy(),
        )
        for seen in frames
    )


def _with_free(vocabulary: ActionVocabulary, actions: Sequence[str]) -> ActionVocabulary:
    """Return the vocabulary, with ``free`` where there was a jump."""
    if FREE not in actions or FREE in vocabulary.names:
        return vocabulary
    return ActionVocabulary((*vocabulary.actions, Action(FREE)))


def _told_body(info: TrajectoryInfo) -> dict[str, float]:
    """Return what says how high the camera is, where that is known, so that walls stop agents in the recording too."""
    if not tells_body(info):
        return {}
    body = body_of(info)
    return {"camera_height": body.camera_height, "radius": body.radius}
