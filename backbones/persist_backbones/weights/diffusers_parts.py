"""The parts that diffusers brings: made of a configuration, or loaded from its folder with all of their weights."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from diffusers import AutoencoderKLCogVideoX, CogVideoXDDIMScheduler, CogVideoXTransformer3DModel

from persist_backbones.weights.pretrained import missing_files
from persist_cli.world.errors import CheckpointError
from persist_cli.world.files import reallocate
from persist_cli.world.quiet import silent

SUBFOLDERS = {
    "transformer": CogVideoXTransformer3DModel,
    "vae": AutoencoderKLCogVideoX,
    "scheduler": CogVideoXDDIMScheduler,
}

MAY_BE_ZERO = {"dropout", "freq_shift", "ofs_embed_dim", "norm_eps", "shift_factor"}  # of numbers in configurations


@dataclass(frozen=True)
class DiffusersParts:
    """What diffusers brings: transformer, autoencoder and scheduler."""

    transformer: CogVideoXTransformer3DModel
    vae: AutoencoderKLCogVideoX
    scheduler: CogVideoXDDIMScheduler


def planning() -> bool:
    """Whether what is made now is a plan: torch's default device is the meta device, so no weights are read."""
    return torch.empty(0).is_meta


def load_parts(folder: Path) -> DiffusersParts:
    """The parts of a diffusers directory with ``transformer/``, ``vae/`` and ``scheduler/``; of a plan, their shapes.

    Raises:
        CheckpointError: one line when a part is missing, corrupt or does not fit its configuration.
    """
    return DiffusersParts(*(_load_part(folder, name) for name in SUBFOLDERS))


def _load_part(folder: Path, name: str) -> Any:
    if not (folder / name).is_dir():
        raise CheckpointError(
            f"{folder}: no {name}/ folder; a diffusers CogVideoX directory has {', '.join(SUBFOLDERS)}"
        )
    config = _read_config(folder, name)
    if planning():
        return make_part(name, config)
    missing = missing_files(folder / name)
    if missing:
        raise CheckpointError(f"{folder / name}: no {missing[0]} in it; take a whole copy, its weights as safetensors")
    options: dict[str, Any] = {"subfolder": name, "local_files_only": True}
    try:
        if name == "scheduler":
            return SUBFOLDERS[name].from_pretrained(folder, **options)
        with silent("diffusers.models.modeling_utils"):  # what it warns of is refused below
            part, found = SUBFOLDERS[name].from_pretrained(
                folder, use_safetensors=True, low_cpu_mem_usage=False, output_loading_info=True, **options
            )
    except (OSError, ValueError, RuntimeError, KeyError, TypeError) as error:
        raise CheckpointError(f"{folder / name}: cannot be loaded ({_cause(error)})") from error
    computed = () if config.get("use_learned_positional_embeddings") else ("patch_embed.pos_embedding",)
    _check_all_loaded(folder / name, found, computed)
    reallocate(part)
    return part


def _check_all_loaded(folder: Path, found: dict[str, Any], computed: Sequence[str]) -> None:
    """Raise ``CheckpointError`` where weights and configuration differ, of which diffusers leaves the rest random.

    Args:
        folder: of both.
        found: what diffusers says of loading them.
        computed: tensors that may stand in the weights or not.
    """
    for problem, names in (("lack", found["missing_keys"]), ("have besides", found["unexpected_keys"])):
        names = sorted(set(names) - set(computed))
        if names:
            raise CheckpointError(
                f"{folder}: its weights {problem} {len(names)} tensors of its config.json, first {names[0]!r}; "
                "take a whole copy of both"
            )


def _read_config(folder: Path, name: str) -> dict[str, Any]:
    try:
        config = SUBFOLDERS[name].load_config(folder, subfolder=name, local_files_only=True)
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{folder / name}: its configuration cannot be read ({_cause(error)})") from error
    if not isinstance(config, dict):
        raise CheckpointError(f"{folder / name}: its configuration is no mapping; take a whole copy")
    return {key: value for key, value in config.items() if not key.startswith("_")}


def make_part(name: str, config: dict[str, Any]) -> Any:
    """A fresh part of this configuration; of a plan, its shapes.

    Args:
        name: a key of ``SUBFOLDERS``.
        config: what its class takes.

    Raises:
        CheckpointError: one line for what diffusers cannot make, and for sizes below 1.
    """
    values = name == "scheduler"  # its tables are values and no weights, also of a plan
    _check_sizes(name, config)
    try:
        with torch.device("cpu") if values else contextlib.nullcontext():
            return SUBFOLDERS[name](**config)
    except (TypeError, ValueError, IndexError, ArithmeticError) as error:
        raise CheckpointError(f"diffusers cannot make a {name} of these settings ({_cause(error)})") from error


def _check_sizes(name: str, config: dict[str, Any]) -> None:
    """Raise ``CheckpointError`` for sizes below 1, which torch takes and nobody can compute with."""
    empty = [key for key, value in config.items() if type(value) is int and value < 1 and key not in MAY_BE_ZERO]
    if empty and name != "scheduler":
        given = ", ".join(f"{key} {config[key]}" for key in empty)
        raise CheckpointError(f"diffusers cannot make a {name} of these settings ({given}: at least 1)")


def _cause(error: Exception) -> str:
    lines = [line.strip() for line in str(error).strip().splitlines()]
    first = " ".join(lines[: 2 if lines and lines[0].endswith(":") else 1])
    return first or type(error).__name__
