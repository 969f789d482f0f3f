"""The checkpoints that a run keeps: the newest, those that ended a recipe, and those that other runs stand on.

A run that starts from a checkpoint of another run leaves a small JSON file beside it, in ``used-by/``, whose name
begins with that of the checkpoint. As long as the file is there, the run that owns the checkpoint does not delete it.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from persist_cli.api.checkpoint import STEP, Checkpoint, step_folders
from persist_cli.checkpoints.lineage import RECIPE
from persist_cli.errors import PersistError
from persist_cli.io.command_line import quoted
from persist_cli.io.files import empty_folder_aside, read_json, relative_place, write_json
from persist_cli.output.console import warn
from persist_cli.recipe import recipe_values

USERS: Final = "used-by"  # the folder of the marks, beside the checkpoints of a run


@dataclass(frozen=True)
class KeptCheckpoint:
    """A checkpoint that a run keeps.

    Args:
        folder: the folder ``step-…``.
        reasons: why, in words; none for one of the newest.
    """

    folder: Path
    reasons: Sequence[str]

    def __str__(self) -> str:
        name = f"step {self.folder.name.removeprefix(STEP).lstrip('0')}"
        return f"{name} ({', '.join(self.reasons)})" if self.reasons else name


def mark_in_use(checkpoint: Checkpoint, run: Path) -> None:
    """Leave a file beside a checkpoint which says that a run stands on it, where it is part of a run, and so its base.

    Where no file can be written, as on read-only media, a line on standard error says what to do.
    """
    user = run.resolve()
    for path, step in _marks_of(checkpoint, run).items():
        if path.is_file():
            continue
        try:
            write_json(path, {"checkpoint": step.name, "run": relative_place(user, step.parent)})
        except OSError as error:
            if not ended_recipe(step):
                warn(
                    f"{path.parent}: cannot be written ({error.strerror}), so nothing says there that {run} stands on "
                    f"{step.name}; before that base is trained further, copy {step} and run: "
                    f"persist relink {quoted(run)} THE_COPY"
                )


def unmark_in_use(checkpoint: Checkpoint, run: Path) -> None:
    """Remove the files that ``mark_in_use`` left, for a run that came to nothing."""
    for path in _marks_of(checkpoint, run):
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)


def kept_checkpoints(run: Path, newest: int) -> list[KeptCheckpoint]:
    """The checkpoints that a run keeps, the newest last.

    Args:
        run: the run's folder.
        newest: how many of the newest are kept without any other reason.
    """
    steps = step_folders(run)
    checkpoints = [KeptCheckpoint(step, _reasons(step, step == steps[-1])) for step in steps]
    recent = set(steps[-newest:])
    return [checkpoint for checkpoint in checkpoints if checkpoint.reasons or checkpoint.folder in recent]


def remove_superseded(run: Path, newest: int) -> None:
    """Delete the checkpoints that a run does not keep; one that another run begins to stand on meanwhile stays.

    So does one that cannot be moved away, as on Windows while somebody reads it: a line says so, and the next call
    tries again.

    Args:
        run: the run's folder.
        newest: how many of the newest are kept without any other reason.
    """
    kept = {checkpoint.folder for checkpoint in kept_checkpoints(run, newest)}
    for step in step_folders(run):
        if step in kept:
            continue
        try:
            _remove(step)
        except OSError as error:
            warn(f"{step}: is not needed any more, but cannot be removed now ({error.strerror})")


def _remove(step: Path) -> None:
    """Delete a checkpoint, unless another run begins to stand on it meanwhile."""
    with empty_folder_aside(step) as aside:
        step.rename(aside / step.name)  # whoever begins on it now sees that it is gone
        if _marks(step):
            (aside / step.name).rename(step)


def ended_recipe(step: Path) -> bool:
    """Whether a checkpoint is at the last step of its recipe."""
    path = step / "model" / RECIPE
    try:
        training = recipe_values(path).get("training")
    except (OSError, PersistError):
        return False
    return isinstance(training, dict) and f"{STEP}{training.get('steps', 0):08d}" == step.name


def _reasons(step: Path, last: bool) -> list[str]:
    users = [_user(mark) for mark in _marks(step)]
    ended = ["ended its recipe"] if not last and ended_recipe(step) else []
    if len(users) > 2:
        return [*ended, f"{users[0]} and {len(users) - 1} more stand on it"]
    return [*ended, f"{' and '.join(users)} {'stands' if len(users) == 1 else 'stand'} on it"] if users else ended


def _marks_of(checkpoint: Checkpoint, run: Path) -> dict[Path, Path]:
    """The files that say that a run stands on a checkpoint and on its base, and the folders ``step-…`` of these."""
    user = run.resolve()
    own = hashlib.sha256(bytes(user)).hexdigest()[:8]  # several machines may write marks at once
    steps = {folder.resolve().parent for folder in (checkpoint.folder, checkpoint.base_folder)}
    marked = sorted(step for step in steps if step.name.startswith(STEP))
    return {step.parent / USERS / f"{step.name}.{user.name}-{own}.json": step for step in marked}


def _marks(step: Path) -> list[Path]:
    return sorted((step.parent / USERS).glob(f"{step.name}.*.json"))


def _user(mark: Path) -> str:
    """The run that a mark names, as seen from the working directory where it is below."""
    try:
        run = (mark.parent.parent / read_json(mark)["run"]).resolve()
    except (PersistError, KeyError, TypeError):
        return mark.stem.partition(".")[2]  # the name says enough
    here = Path.cwd()
    return str(run.relative_to(here) if run.is_relative_to(here) else run)
