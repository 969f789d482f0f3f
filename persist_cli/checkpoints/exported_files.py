"""The files of an exported folder: weights in another precision, settings and recipes without a machine's paths."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any, Final

import torch
import yaml

from persist_cli.api.checkpoint import CARD, STEP
from persist_cli.checkpoints.lineage import RECIPE, RECIPES
from persist_cli.errors import CheckpointError
from persist_cli.io.command_line import quoted
from persist_cli.io.files import read_json, read_tensors, write_json, write_tensors, write_text
from persist_cli.io.sha256sums import SUMS, read_sums
from persist_cli.io.yaml_text import parse_yaml_mapping
from persist_cli.output.console import print_json, print_table, say

MADE_ANEW: Final = {CARD, RECIPE, SUMS}  # files at the top of a checkpoint's folder that an export does not copy

LOADED_FROM: Final = "_name_or_path"  # the key under which diffusers notes where it once loaded a part from


def is_copied(path: Path) -> bool:
    """Whether a file of a base, by its path in the folder, is the backbone's and not one that an export makes anew."""
    hidden = any(part.startswith(".") for part in path.parts)
    return str(path) not in MADE_ANEW and path.parts[0] != RECIPES and not hidden


def copy_part(source: Path, target: Path) -> None:
    """Copy a file; a configuration of diffusers without the folder that it was loaded from."""
    values = read_json(source) if source.suffix == ".json" else None
    if not isinstance(values, dict) or LOADED_FROM not in values:
        shutil.copyfile(source, target)
        return
    write_json(target, {key: value for key, value in values.items() if key != LOADED_FROM})


def convert(source: Path, target: Path, dtype: torch.dtype) -> None:
    """Write a weight file in another precision; integers stay integers.

    Raises:
        CheckpointError: when a value is too large for the precision, naming the tensor.
    """
    tensors, metadata = read_tensors(source)
    for name, tensor in tensors.items():
        if not tensor.is_floating_point():
            continue
        tensors[name] = tensor.to(dtype)
        if not torch.equal(tensors[name].isfinite(), tensor.isfinite()):
            most, limit = float(tensor.abs().max()), torch.finfo(dtype).max
            raise CheckpointError(
                f"{source}: {name!r} holds {most:.4g}, more than {str(dtype).removeprefix('torch.')} can "
                f"({limit:.4g}); export with --dtype bfloat16 or float32"
            )
    write_tensors(target, tensors, metadata)


def copy_network(source: Path, folder: Path, dtype: torch.dtype) -> None:
    """Write the weights and the recipe of a network into a folder."""
    for weights in sorted(source.glob("*.safetensors")):
        convert(weights, folder / weights.name, dtype)
    recipe = source / RECIPE
    if recipe.is_file():
        write_text(folder / RECIPE, without_absolute_paths(recipe.read_text(encoding="utf-8"), str(recipe)))


def without_absolute_paths(text: str, where: str) -> str:
    """The text of a recipe in which of absolute paths only the last part is kept; they lead nowhere elsewhere.

    Args:
        text: YAML.
        where: what an error names.
    """
    values = parse_yaml_mapping(text, where)
    data: dict[str, Any] = values.get("data") or {}
    settings: dict[str, Any] = (values.get("backbone") or {}).get("settings") or {}
    memory: dict[str, Any] = (values.get("memory") or {}).get("settings") or {}
    places = [(values, "base"), (values, "adapter_from"), (values.get("distill") or {}, "teacher"), (data, "path")]
    for owner, key in (*places, (settings, "pretrained"), (settings, "prompt_embedding"), (memory, "model")):
        if key in owner:
            owner[key] = _last_part(owner[key])
    return yaml.safe_dump(values, sort_keys=False)


def _last_part(value: Any) -> Any:
    if isinstance(value, list):
        return [_last_part(path) for path in value]
    if not isinstance(value, str) or not Path(value).is_absolute():
        return value
    path = Path(value)
    return path.parent.name if path.name.startswith(STEP) else path.name  # that of its run


def summed_files(folder: Path) -> dict[str, dict[str, Any]]:
    """Bytes and hash of each file of an exported network."""
    hashes = read_sums(folder) or {}
    return {name: {"bytes": (folder / name).stat().st_size, "sha256": hashes[name]} for name in sorted(hashes)}


def print_files(out: Path, card: dict[str, Any], files: dict[str, dict[str, Any]], json: bool) -> None:
    """Print a table of the files of an export, or all that is known of it as JSON.

    Args:
        out: its folder.
        card: what its card says.
        files: bytes and hash by name.
        json: whether JSON is printed.
    """
    total = sum(file["bytes"] for file in files.values())
    if json:
        print_json({"folder": str(out), **card, "bytes": total, "files": files})
        return
    rows = [(name, f"{file['bytes']:,}") for name, file in files.items()]
    print_table(str(out), ("file", "bytes"), [*rows, ("all", f"{total:,}")])
    say(f"{total / 1e6:.1f} MB, weights in {card['dtype']}; check them with: cd {quoted(out)} && sha256sum -c {SUMS}")
