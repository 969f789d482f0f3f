"""What an export is made of: a base, adapters under their names, and the recipes behind them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from persist_cli.checkpoints import PLAIN, Checkpoint, find_checkpoint
from persist_cli.lineage import RECIPE, RECIPES, stage_recipes
from persist_cli.recipe import parse_yaml_mapping
from persist_cli.world.errors import CheckpointError

ADAPTERS = "adapters"  # the folder of their recipes
NAMED = re.compile(r"(?P<name>[A-Za-z0-9][A-Za-z0-9_-]*)=(?P<run>.+)")


@dataclass(frozen=True)
class Part:
    """One adapter of an export.

    Args:
        checkpoint: that has it.
        adapter: what it is called there.
    """

    checkpoint: Checkpoint
    adapter: str

    @property
    def folder(self) -> Path:
        """Where its files are."""
        return self.checkpoint.adapter_folder(self.adapter)


def adapter_parts(base: Checkpoint, runs: Sequence[str]) -> dict[str, Part]:
    """The base's own adapters and those of the runs, by the names that they get.

    Args:
        base: whose backbone is exported.
        runs: ``RUN``, whose adapters keep their names, or ``NAME=RUN``.

    Raises:
        CheckpointError: for an adapter of another base, and for one name twice.
    """
    parts = {name: Part(base, name) for name in base.adapters}
    for text in runs:
        for name, part in _parts_of_run(text).items():
            if part.checkpoint.fingerprint != base.fingerprint:
                raise CheckpointError(f"{part.checkpoint.folder}: its adapter is of another base than {base.folder}")
            if name in parts:
                raise CheckpointError(
                    f"{part.checkpoint.folder}: adapter {name!r} is there already, from {parts[name].checkpoint.folder}"
                    f"; name this one, as in {name}-other={text.removeprefix(f'{name}=')}"
                )
            parts[name] = part
    return parts


def _parts_of_run(text: str) -> dict[str, Part]:
    match = None if Path(text).exists() else NAMED.fullmatch(text)
    found = find_checkpoint(Path(match["run"] if match else text))
    if not found.adapters:
        raise CheckpointError(f"{found.folder}: has no memory adapter; name stage-2 runs after the CHECKPOINT")
    if match is None:
        return {name: Part(found, name) for name in found.adapters}
    if len(found.adapters) > 1:
        raise CheckpointError(f"{found.folder}: NAME=RUN names one adapter, there are {', '.join(found.adapters)}")
    if match["name"] == PLAIN:
        raise CheckpointError(f"{text}: {PLAIN!r} is the base without an adapter; choose another name")
    return {match["name"]: Part(found, next(iter(found.adapters)))}


def known_recipes(base: Checkpoint, parts: dict[str, Part]) -> dict[str, str]:
    """Texts of the recipes behind an export by file name: those of the base's stages and ``adapters/NAME.yaml``.

    Absolute paths are cut to their last part: they say nothing elsewhere.
    """
    recipes = stage_recipes(base.base_folder)
    for name, part in parts.items():
        folder = part.checkpoint.folder
        for path in (folder / RECIPES / ADAPTERS / f"{part.adapter}.yaml", folder / RECIPE):
            if path.is_file():
                recipes[f"{ADAPTERS}/{name}.yaml"] = path.read_text(encoding="utf-8")
                break
    return {name: _without_places(text, name) for name, text in recipes.items()}


def _without_places(text: str, where: str) -> str:
    values = parse_yaml_mapping(text, where)
    data: dict[str, Any] = values.get("data") or {}
    settings: dict[str, Any] = (values.get("backbone") or {}).get("settings") or {}
    places = ((values, "base"), (data, "path"), (settings, "pretrained"), (settings, "prompt_embedding"))
    for owner, key in places:
        owner |= {key: _without_place(owner[key])} if key in owner else {}
    return yaml.safe_dump(values, sort_keys=False)


def _without_place(value: Any) -> Any:
    if isinstance(value, list):
        return [_without_place(each) for each in value]
    return Path(value).name if isinstance(value, str) and Path(value).is_absolute() else value
