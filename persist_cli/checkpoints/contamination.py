"""Scenes that a model was trained on are not measured: its figures would not be of what it has never seen."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from persist_cli.api.checkpoint import Checkpoint
from persist_cli.api.training_scenes import TrainingScenes
from persist_cli.checkpoints.lineage import training_scenes
from persist_cli.data.held_out import SEQUENCE, scene_was_trained_on
from persist_cli.data.store import TrajectoryFile
from persist_cli.errors import DataError
from persist_cli.output.console import warn
from persist_cli.policies.trained import TrainedPolicy

OTHER_DATA: Final = "take data of another split"

ALLOW: Final = "measure it all the same with --allow-training-scenes"


@dataclass(frozen=True)
class ShownScene:
    """A scene that is measured.

    Args:
        name: of the scene.
        path: of the trajectory that shows it; ``None`` for a scene that a simulator opens.
        sequence: which of the scene's sequences the trajectory is; ``None`` for any.
        first: number of the first frame that is measured.
    """

    name: str
    path: Path | None = None
    sequence: str | None = None
    first: int = 0

    @staticmethod
    def of(file: TrajectoryFile, first: int = 0) -> ShownScene:
        """Return what a trajectory shows from the frame with a number on."""
        return ShownScene(file.info.scene, file.path, file.info.source.get(SEQUENCE), first)


def refuse_training_scenes(
    shown: Iterable[ShownScene], names: Collection[str], way_out: str, who: str = "the model"
) -> None:
    """Raise ``DataError`` when something was trained on a scene that is measured.

    Args:
        shown: the scenes that are measured.
        names: of the scenes and parts of scenes that it was trained on.
        way_out: what the user may do, the end of the message.
        who: was trained on them.
    """
    for scene in shown:
        if scene_was_trained_on(scene.name, names, scene.first, scene.sequence):
            which = f"scene {scene.name!r}"
            where, what = (which, "it") if scene.path is None else (scene.path, f"its {which}")
            raise DataError(f"{where}: {who} was trained on {what}; {way_out}")


def refuse_training_episodes(
    scenes: Sequence[str], checkpoint: Checkpoint | None, policy: TrainedPolicy | None, allowed: bool
) -> None:
    """Raise ``DataError`` when model or policy were trained on a scene of some episodes, unless that is allowed.

    Args:
        scenes: names of the scenes of the episodes.
        checkpoint: of the model; ``None`` without one.
        policy: that was trained; ``None`` without one.
        allowed: whether such scenes may be measured.
    """
    trained = {} if checkpoint is None else {"the model": scenes_to_avoid([checkpoint])}
    if policy is not None:
        trained[f"policy {str(policy.folder)!r}"] = known_names(policy.training_scenes, policy.folder, "this policy")
    if allowed:
        return
    for who, names in trained.items():
        refuse_training_scenes(map(ShownScene, scenes), names, f"take episodes of another split, or {ALLOW}", who)


def scenes_to_avoid(checkpoints: Iterable[Checkpoint]) -> frozenset[str]:
    """Return the names of the scenes that the checkpoints were trained on, as ``known_names`` does."""
    names: frozenset[str] = frozenset()
    for checkpoint in checkpoints:
        names |= known_names(training_scenes(checkpoint), checkpoint.folder)
    return names


def known_names(scenes: TrainingScenes | None, folder: Path, what: str = "it") -> frozenset[str]:
    """Return the names of the scenes that something was trained on, with a warning where not all of them are known.

    Args:
        scenes: that are known; ``None`` for none.
        folder: of what was trained.
        what: the word for it in the warning.
    """
    scenes = scenes or TrainingScenes(complete=False)
    if not scenes.complete:
        count = f" ({len(scenes.names)} are)" if scenes.names else ""
        warn(f"{folder}: not all scenes that {what} was trained on are known{count}")
    return scenes.names
