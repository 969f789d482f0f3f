"""Training seeds: checkpoints that one recipe trained with several seeds are one row, whose spread the table shows."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from persist_cli.api.checkpoint import Checkpoint
from persist_cli.checkpoints.lineage import ADAPTERS, adapter_recipe, stage_recipes
from persist_cli.errors import CheckpointError
from persist_cli.io.begun_with import first_difference
from persist_cli.io.yaml_text import parse_yaml_mapping

OWN = ("base", "description", "chosen_on")  # keys of a recipe that may differ between training seeds


@dataclass(frozen=True)
class Training:
    """How a model was trained.

    Args:
        schedule: the recipes of all its stages but for their seeds, as JSON; empty when no recipe is known.
        seeds: the seed of each stage, that of the adapter last.
    """

    schedule: str
    seeds: tuple[int, ...]


def training_of(checkpoint: Checkpoint, adapter: str | None) -> Training:
    """How the base of a checkpoint, and one of its adapters, were trained."""
    texts = dict(stage_recipes(checkpoint.base_folder))
    if adapter is not None:
        text = adapter_recipe(checkpoint, adapter)
        texts |= {ADAPTERS: text} if text is not None else {}
    schedule: dict[str, Any] = {}
    seeds = []
    for name, text in texts.items():
        values = {key: value for key, value in parse_yaml_mapping(text, name).items() if key not in OWN}
        training = dict(values.get("training") or {})
        seeds.append(int(training.pop("seed", 0)))
        schedule[name] = values | {"training": training}
    return Training(json.dumps(schedule, sort_keys=True, default=str) if schedule else "", tuple(seeds))


def group_by_training(checkpoints: Sequence[Checkpoint], adapter: str | None) -> list[list[Checkpoint]]:
    """Checkpoints of one schedule together, in order; those without known recipes alone.

    Raises:
        CheckpointError: when two of a group were trained with the same seeds, so that they are one training.
    """
    groups: dict[str, list[Checkpoint]] = {}
    seeds: dict[tuple[str, tuple[int, ...]], Checkpoint] = {}
    for checkpoint in checkpoints:
        training = training_of(checkpoint, adapter)
        schedule = training.schedule or str(checkpoint.folder)
        twin = seeds.setdefault((schedule, training.seeds), checkpoint)
        if twin is not checkpoint:
            raise CheckpointError(
                f"{twin.folder} and {checkpoint.folder} were trained with the same seeds "
                f"({', '.join(map(str, training.seeds))}): give one of them, or train with another training.seed"
            )
        groups.setdefault(schedule, []).append(checkpoint)
    return list(groups.values())


def is_reordered(owners: tuple[Sequence[Checkpoint], str | None]) -> bool:
    """Whether groups one after the other are another order than that of some checkpoints of an adapter."""
    checkpoints, adapter = owners
    try:
        groups = group_by_training(checkpoints, adapter)
    except CheckpointError:  # they were never grouped
        return False
    return [checkpoint for group in groups for checkpoint in group] != list(checkpoints)


def check_any_grouped(groups: Sequence[list[Checkpoint]], adapter: str | None) -> None:
    """Raise ``CheckpointError`` when no group has two checkpoints, naming what the first two differ in."""
    if any(len(group) > 1 for group in groups):
        return
    if len(groups) < 2:
        raise CheckpointError(
            "--training-seeds: each memory has one checkpoint; give runs of one recipe with other training.seed"
        )
    one, two = (group[0] for group in groups[:2])
    schedules = [json.loads(training_of(checkpoint, adapter).schedule or "{}") for checkpoint in (one, two)]
    raise CheckpointError(
        f"--training-seeds: {one.folder} and {two.folder} differ in more than seeds ({first_difference(*schedules)})"
    )
