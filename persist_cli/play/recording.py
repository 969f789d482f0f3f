"""What was walked through, kept to be saved as a video and as a data set."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import torch

from persist_cli.api.actions import FREE, Action, ActionVocabulary
from persist_cli.api.observations import Frame, Observations, TrajectoryInfo
from persist_cli.data.store import SUFFIX, write_trajectory
from persist_cli.errors import PersistError
from persist_cli.io.files import check_folder
from persist_cli.navigation.ground_mapper import body_of, tells_body
from persist_cli.viewing.video import beside, enlarge, labelled, write_video

LONGEST: Final = 5000  # frames of a recording; some 150 MB at 64×64 for each memory
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


@dataclass
class Recording:
    """The frames of a walk, from one on.

    Args:
        names: of the memories.
        first: the frame of each at the beginning.
    """

    names: Sequence[str]
    first: tuple[Observations, ...]
    _steps: list[tuple[str | None, tuple[Observations, ...]]] = field(default_factory=list, init=False)

    def __len__(self) -> int:
        return 1 + len(self._steps)

    @property
    def full(self) -> bool:
        """Whether no more frames are taken."""
        return len(self) >= LONGEST

    def add(self, action: str | None, frames: tuple[Observations, ...]) -> None:
        """Append the frames of all memories after an action, ``None`` for a jump; nothing once it is full."""
        if not self.full:
            self._steps.append((action, frames))

    def undo(self) -> None:
        """Take the last frame away again, if it is not the first."""
        del self._steps[-1:]

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
        actions = [action or FREE for action, _ in self._steps]
        info = replace(info, vocabulary=_with_free(info.vocabulary, actions))
        info = replace(info, source={"format": "play", **_told_body(info), **source})
        videos = []
        for number, name in enumerate(self.names):
            frames = [self.first[number], *(seen[number] for _, seen in self._steps)]
            told = replace(info, source=info.source | {"memory": name})
            write_trajectory(folder / DATA / f"{name}{SUFFIX}", told, _frames(frames, [*actions, None]))
            videos.append(torch.cat([frame.rgb for frame in frames]))
        if len(videos) > 1:
            videos = [beside([labelled(enlarge(one), name) for one, name in zip(videos, self.names, strict=True)])]
        write_video(folder / VIDEO, videos[0], RATE)
        return SavedRecording(len(self), folder / VIDEO, folder / DATA)


def _frames(frames: Sequence[Observations], actions: Sequence[str | None]) -> Iterator[Frame]:
    for number, (seen, action) in enumerate(zip(frames, actions, strict=True)):
        pose = seen.cameras.world_from_camera[0].cpu().double().numpy()
        yield Frame(seen.rgb[0].cpu().numpy(), seen.depth[0].cpu().numpy(), pose, action, number / RATE)


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
