"""What an evaluation was made of: versions, machine, checkpoints and weights."""

from __future__ import annotations

import platform
import sys
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from persist_cli import __version__
from persist_cli.checkpoints import Checkpoint
from persist_cli.metrics.metric import Metric
from persist_cli.recipe import parse_yaml_mapping
from persist_cli.trajectories.store import Store
from persist_cli.world.files import file_sha256, read_json
from persist_cli.world.weights import cached_weight

PACKAGES = ("accelerate", "diffusers", "numpy", "safetensors", "scipy", "torch", "torchmetrics", "transformers")


def environment(processes: int) -> dict[str, Any]:
    """Versions and machine, JSON values."""
    cuda = torch.cuda.is_available()
    return {
        "persist": __version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "platform": platform.platform(),
        "device": torch.cuda.get_device_name() if cuda else platform.processor() or platform.machine(),
        "packages": {name: version(name) for name in PACKAGES},
        "processes": processes,
    }


def command() -> list[str]:
    """The command line as it was given."""
    return ["persist", *sys.argv[1:]]


def checkpoint_json(checkpoint: Checkpoint) -> dict[str, Any]:
    """A checkpoint with the hashes of its base, recipe and adapters, JSON values."""
    recipe = recipe_path(checkpoint.folder)
    adapters = {name: file_sha256(folder / "adapter.safetensors") for name, folder in checkpoint.adapters.items()}
    return {
        "name": checkpoint.name,
        "path": str(checkpoint.folder),
        "fingerprint": checkpoint.fingerprint,
        "recipe_sha256": file_sha256(recipe) if recipe else None,
        "adapters": adapters,
    }


def recipe_path(folder: Path) -> Path | None:
    """The recipe that a run kept in its checkpoint."""
    path = folder / "recipe.yaml"
    return path if path.is_file() else None


def training_scenes(checkpoints: Sequence[Checkpoint]) -> frozenset[str]:
    """Scenes of the data sets that the checkpoints' recipes name, as far as these are still there."""
    folders = {folder for each in checkpoints for folder in (each.folder, each.base_folder)}
    recipes = [path for path in map(recipe_path, sorted(folders)) if path]
    data = {Path(parse_yaml_mapping(path.read_text("utf-8"), str(path))["data"]["path"]) for path in recipes}
    return frozenset(file.info.scene for folder in data if folder.is_dir() for file in Store(folder))


def metric_json(metrics: Mapping[str, Metric]) -> dict[str, Any]:
    """What every metric is, with the hashes of the weights it used, JSON values."""
    return {
        name: {
            "title": metric.title,
            "better": metric.better,
            "definition": metric.definition,
            "weights": weight_hashes(metric.weights),
        }
        for name, metric in metrics.items()
    }


def weight_hashes(names: Sequence[str]) -> dict[str, str]:
    """SHA-256 of the converted weights that are there."""
    found = {name: cached_weight(name) for name in names}
    return {name: str(read_json(folder / "weight.json")["sha256"]) for name, folder in found.items() if folder}
