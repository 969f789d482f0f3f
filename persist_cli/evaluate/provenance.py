"""Provenance of the results: versions, machine, checkpoints, recipes and weights behind an evaluation."""

from __future__ import annotations

import contextlib
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from persist_cli import __version__
from persist_cli.api.checkpoint import WEIGHTS, Checkpoint
from persist_cli.checkpoints import lineage
from persist_cli.checkpoints.load import adapter_memory
from persist_cli.checkpoints.scene_models import find_scene_model, with_model_beside
from persist_cli.data.held_out import was_trained_on
from persist_cli.errors import PersistError
from persist_cli.evaluate.cases import Case
from persist_cli.io.files import file_sha256, files_sha256, read_json
from persist_cli.io.hub import cached_weight
from persist_cli.memorize.imagining import scene_model_fingerprint
from persist_cli.metrics.metric import Metric
from persist_cli.plugin_code import code_json
from persist_cli.recipe import MemoryConfig

PACKAGES = ("accelerate", "diffusers", "numpy", "safetensors", "scipy", "torch", "torchmetrics", "transformers")


def environment(processes: int) -> dict[str, Any]:
    """Versions of the packages and the machine as JSON values."""
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


def checkpoint_json(checkpoint: Checkpoint) -> dict[str, Any]:
    """A checkpoint with the hashes of its base, recipes, adapters and their settings as JSON values."""
    adapters = {name: adapter_json(folder) for name, folder in checkpoint.adapters.items()}
    code = {name: hashes["code"] for name, hashes in adapters.items() if "code" in hashes}
    return {
        "name": checkpoint.name,
        "path": str(checkpoint.folder),
        "fingerprint": checkpoint.fingerprint,
        "recipe_sha256": recipe_sha256(checkpoint.folder),
        "adapters": {name: hashes["weights"] for name, hashes in adapters.items()},
        "adapter_settings": {name: hashes["settings"] for name, hashes in adapters.items()},
        **code_json(("backbone", checkpoint.backbone)),
        **({"adapter_code": code} if code else {}),
    }


def adapter_json(folder: Path) -> dict[str, Any]:
    """The hashes of an adapter's weights and of its settings, among them the memory that it reads, as JSON values.

    Where memory, encoder or the model that imagines are of another package, that of their code is there as well.
    """
    files = list(folder.glob(f"*{WEIGHTS}"))
    weights = file_sha256(files[0]) if len(files) == 1 else files_sha256(folder, files)
    settings = files_sha256(folder, folder.glob("*.json"))
    return {"weights": weights, "settings": settings, **code_json(*adapter_plugins(folder))}


def adapter_plugins(folder: Path) -> list[tuple[str, str]]:
    """The plugins that the memory of an adapter needs, by kind and name; none is loaded."""
    memory = asdict(MemoryConfig()) | read_json(folder / lineage.MEMORY_FILE)
    plugins = [("memory", memory["name"]), ("encoder", memory["encoder"])]
    model = with_model_beside(memory["settings"], folder).get("model")
    if model is not None:
        with contextlib.suppress(PersistError):  # whoever imagines with it says so
            plugins.append(("scene model", find_scene_model(str(model)).plugin))
    return plugins


def scene_models(checkpoints: Sequence[Checkpoint], memories: Sequence[str]) -> list[dict[str, str]]:
    """For each checkpoint the hash of the model that imagines in the scenes of each of these memories that has one."""
    hashes = [
        {name: scene_model_fingerprint(adapter_memory(one, name)) for name in memories if name in one.adapters}
        for one in checkpoints
    ]
    return [{name: found for name, found in of_one.items() if found} for of_one in hashes]


def scenes_json(checkpoint: Checkpoint, cases: Sequence[Case] = ()) -> dict[str, Any]:
    """The number of scenes that a checkpoint is known to have been trained on, as JSON values.

    The number may change between runs: it depends on which earlier checkpoints and data sets can still be read.
    ``evaluated`` names those of them that the cases show. ``chosen_on`` says on which data the settings were chosen,
    where card or recipe does.
    """
    scenes = lineage.training_scenes(checkpoint)
    return {
        "chosen_on": lineage.chosen_on(checkpoint),
        "training_scenes": {
            "known": len(scenes.names),
            "complete": scenes.complete,
            "evaluated": trained_on(checkpoint, cases),
        },
    }


def shown_scenes(cases: Sequence[Case]) -> frozenset[str]:
    """Names of the scenes that the cases show."""
    return frozenset(case.scene for case in cases)


def trained_on(checkpoint: Checkpoint, cases: Sequence[Case]) -> list[str]:
    """Names of the cases' scenes that a checkpoint is known to have been trained on, in order.

    Where it was trained on the first frames of a scene only, cases of later frames do not count.
    """
    names = lineage.training_scenes(checkpoint).names
    earliest: dict[tuple[str, str], Case] = {}
    for case in sorted(cases, key=lambda case: case.start):
        earliest.setdefault((case.data, case.trajectory), case)
    return sorted({case.scene for case in earliest.values() if was_trained_on(case.file.info, names, case.start)})


def recipe_sha256(folder: Path) -> str | None:
    """SHA-256 of the recipe in a run's checkpoint, or over the names and texts of all recipes of an exported model.

    ``None`` when there is none.
    """
    if (folder / lineage.RECIPE).is_file():
        return file_sha256(folder / lineage.RECIPE)
    home = folder / lineage.RECIPES
    recipes = list(home.rglob("*.yaml"))
    return files_sha256(home, recipes) if recipes else None


def metric_json(metrics: Mapping[str, Metric]) -> dict[str, Any]:
    """Every metric's definition with the hashes of the weights it used, as JSON values."""
    return {
        name: {
            "title": metric.title,
            "better": metric.better,
            "definition": metric.definition,
            "weights": weight_hashes(metric.weights),
            "sources": weight_sources(metric.weights),
        }
        for name, metric in metrics.items()
    }


def weight_hashes(names: Sequence[str]) -> dict[str, str]:
    """SHA-256 of the converted weights that are in the cache, by name."""
    folders = {name: cached_weight(name) for name in names}
    return {name: str(read_json(folder / "weight.json")["sha256"]) for name, folder in folders.items() if folder}


def weight_sources(names: Sequence[str]) -> dict[str, str]:
    """Where the weights in the cache came from, by name, as far as that is known."""
    folders = {name: cached_weight(name) for name in names}
    cards = {name: read_json(folder / "weight.json") for name, folder in folders.items() if folder}
    return {name: str(card["source"]) for name, card in cards.items() if card.get("source")}
