"""Pretrained weights: a local directory or a repository of the hub, and the parts that diffusers reads there."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from diffusers import AutoencoderKLCogVideoX, CogVideoXDDIMScheduler, CogVideoXTransformer3DModel

from persist_cli.errors import CheckpointError
from persist_cli.io.files import read_json, reallocate
from persist_cli.io.hub import hub_obstacle, silent

PARTS = ("transformer", "vae", "scheduler")

REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")

WEIGHTS = "diffusion_pytorch_model.safetensors"  # of a part that is not split into several files

PUBLISHED = {  # what the repositories of THUDM, now zai-org, hold
    "CogVideoX-2b": "2b",
    "CogVideoX-5b": "5b",
    "CogVideoX-5b-I2V": "5b-i2v",
    "CogVideoX1.5-5B": "1.5-5b",
    "CogVideoX1.5-5B-I2V": "1.5-5b-i2v",
}


def published_preset(name: str) -> str | None:
    """The preset that has the sizes of a published model's repository, ``None`` for any other name."""
    owner, _, model = name.partition("/")
    return PUBLISHED.get(model) if owner in ("THUDM", "zai-org") else None


def origin_of(pretrained: str | None) -> dict[str, str]:
    """The setting that finds pretrained weights from wherever one stands; none for none."""
    if not pretrained:
        return {}
    return {"pretrained": str(Path(pretrained).resolve()) if Path(pretrained).is_dir() else pretrained}


def folder_here(name: str) -> Path | None:
    """The local directory of this name, else what the hub's cache has of a repository; ``None`` when there is neither.

    The network is not asked.
    """
    from huggingface_hub import errors, snapshot_download

    folder = Path(name).expanduser()
    if folder.is_dir():
        return folder
    if not REPOSITORY.fullmatch(name):
        return None
    try:
        return Path(snapshot_download(name, local_files_only=True))
    except errors.LocalEntryNotFoundError:
        return None


def check_name(name: str) -> None:
    """Raise ``CheckpointError`` for what is no local directory and cannot be a repository of the hub either."""
    if not REPOSITORY.fullmatch(name):
        raise CheckpointError(f"{name}: no such directory, and not the name of a repository on the hub (owner/model)")


def pretrained_folder(name: str) -> Path:
    """The local directory of this name, else that of a repository of the hub in its cache.

    What the cache lacks of transformer, VAE and scheduler is downloaded; a text encoder never is.

    Raises:
        CheckpointError: one line when there is no such directory, and the repository cannot be had either.
    """
    folder = folder_here(name)
    if folder is not None and (not _of_the_hub(name) or not any(missing_files(folder / part) for part in PARTS)):
        return folder
    check_name(name)
    obstacle = hub_obstacle()
    if obstacle:
        parts = " ".join(f"'{part}/*'" for part in PARTS)
        raise CheckpointError(
            f"{name}: no such directory, not whole in the hub's cache, and the hub: {obstacle}; give a local diffusers "
            f"directory, or fetch it elsewhere: hf download {name} --include {parts}"
        )
    return _download(name)


def _of_the_hub(name: str) -> bool:
    return not Path(name).expanduser().is_dir()


def _download(name: str) -> Path:
    from huggingface_hub import errors, snapshot_download

    wanted = [f"{part}/*.{kind}" for part in PARTS for kind in ("json", "safetensors")]
    try:
        return Path(snapshot_download(name, allow_patterns=wanted))
    except (OSError, ValueError, errors.HfHubHTTPError) as error:
        cause = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise CheckpointError(f"{name}: the hub does not give it ({cause})") from error


def missing_files(part: Path) -> list[str]:
    """Names of the configuration and of the weights that a part's folder ought to have and has not."""
    if part.name == "scheduler":
        wanted = ["scheduler_config.json"]
    else:
        index = part / "diffusion_pytorch_model.safetensors.index.json"
        weights = set(read_json(index)["weight_map"].values()) if index.is_file() else {WEIGHTS}
        wanted = ["config.json", *sorted(weights)]
    return [name for name in wanted if not (part / name).is_file()]


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


def on_meta_device() -> bool:
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
    if on_meta_device():
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
