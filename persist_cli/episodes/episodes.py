"""Episodes of navigation: a scene, a start, a goal and the shortest way, in a JSON file that others can run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from persist_cli.api.simulator import Stand
from persist_cli.errors import DataError
from persist_cli.io.files import read_json, write_json
from persist_cli.io.settings import plain_problems

FORMAT: Final = "persist-episodes"

VERSION: Final = 1

SIGHT_SHARE = 0.25  # of the goal image, from which on the goal is in sight of a frame that shows so much of it

DEFINITIONS: Final = {
    "length": (
        "the bin is the number of actions of the shortest way to the goal's pose; a step forward and a turn count one "
        "each; found by breadth-first search over poses in cells of half a step and one turn; the last action is a step"
    ),
    "metres": "length of that way: steps times the length of a step",
    "in_sight": (
        "the start frame shows a point of the upright line from the goal's camera to 1 m below it, or at least "
        f"{SIGHT_SHARE:.0%} of what the goal image shows (pixels of a 16×16 grid, by depth)"
    ),
    "walk": (
        "the given walk begins at the goal and goes to the start by a short way; it looks once around as soon as it is "
        "`goal_gap` metres away from the goal; `keep` are the numbers of its frames that are given, evenly spaced, of "
        "those that are as far away"
    ),
}


class EpisodePart(BaseModel):
    """A part of a file of episodes; unknown keys are ignored, so that files of a later persist can still be read."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class GivenWalk(EpisodePart):
    """The posed images of the scene that an agent has before it starts.

    Args:
        start: where the walk begins.
        actions: as ``ActionVocabulary.parse`` reads them; empty for the first frame alone.
        keep: numbers of its frames that are given, from 0.
        goal_seen: share of the goal image that these frames show.
    """

    start: Stand
    actions: str
    keep: list[int] = Field(min_length=1)
    goal_seen: float


class Episode(EpisodePart):
    """One task: go from the start to the goal.

    Args:
        name: unique in its file.
        scene: seed of the simulator's scene.
        scene_name: name of that scene, as data sets and checkpoints know it.
        bin: number of actions of the shortest way.
        in_sight: whether the goal is in sight from the start.
        goal_share: share of the goal image that the start frame shows.
        start: where the agent starts.
        goal: pose of the goal, whose view is the goal image.
        actions: the shortest way from start to goal.
        metres: length of that way.
        walk: what is given of the scene.
        seed: seed of all that is random when the episode is run.
    """

    name: str
    scene: int = Field(ge=0)
    scene_name: str
    bin: int = Field(ge=1)
    in_sight: bool
    goal_share: float
    start: Stand
    goal: Stand
    actions: str
    metres: float = Field(gt=0)
    walk: GivenWalk
    seed: int = Field(ge=0)


class EpisodeSet(EpisodePart):
    """The episodes of a file with what is needed to run them.

    Args:
        format: ``FORMAT``.
        version: ``VERSION``.
        simulator: name of the simulator's plugin.
        settings: its settings.
        split: of the scenes.
        seed: that the episodes were drawn with.
        goal_gap: metres around the goals from which no frame of the walks is given.
        definitions: what the figures of an episode mean.
        episodes: the episodes, those of one scene together.
    """

    format: Literal["persist-episodes"] = FORMAT
    version: Literal[1] = VERSION
    simulator: str
    settings: dict[str, Any]
    split: str
    seed: int
    goal_gap: float = 0.0
    definitions: dict[str, str] = DEFINITIONS
    episodes: list[Episode] = Field(min_length=1)

    @model_validator(mode="after")
    def _names_differ(self) -> EpisodeSet:
        names = [episode.name for episode in self.episodes]
        repeated = next((name for name in names if names.count(name) > 1), None)
        if repeated is not None:
            raise ValueError(f"two episodes are named {repeated!r}")
        return self

    @property
    def scenes(self) -> list[str]:
        """The names of the scenes, each once."""
        return list(dict.fromkeys(episode.scene_name for episode in self.episodes))

    def chosen(self, bins: Sequence[int] | None) -> EpisodeSet:
        """Return the episodes of some bins; of all with ``None``.

        Raises:
            DataError: when there is no episode of a bin.
        """
        known = sorted({episode.bin for episode in self.episodes})
        for number in bins or ():
            if number not in known:
                raise DataError(f"no episode of {number} actions; the bins here are {', '.join(map(str, known))}")
        kept = [episode for episode in self.episodes if bins is None or episode.bin in bins]
        return self.model_copy(update={"episodes": kept})

    def table(self) -> dict[tuple[int, bool], int]:
        """Return the number of episodes of each bin, in sight or not."""
        kinds = sorted({(episode.bin, not episode.in_sight) for episode in self.episodes})
        return {
            (number, not hidden): sum((one.bin, one.in_sight) == (number, not hidden) for one in self.episodes)
            for number, hidden in kinds
        }

    def write(self, path: Path) -> None:
        """Write the file, whole or not at all."""
        write_json(path, self.model_dump(mode="json"))


def read_episodes(path: Path) -> EpisodeSet:
    """Read a file of episodes.

    Raises:
        DataError: one line when it is missing, not JSON, no episodes, of another version, or damaged.
    """
    value = read_json(path, DataError, f"no such file; `persist bench episodes --out {path}` writes it")
    if not isinstance(value, dict) or value.get("format") != FORMAT:
        raise DataError(f"{path}: holds no episodes (no format {FORMAT!r} in it); `persist bench episodes` writes them")
    if value.get("version") != VERSION:
        raise DataError(f"{path}: episodes of version {value.get('version')!r}; this persist reads version {VERSION}")
    try:
        return EpisodeSet.model_validate(value)
    except ValidationError as error:
        raise DataError(f"{path}: episodes are damaged: {plain_problems(EpisodeSet, value, error)[0]}") from error
