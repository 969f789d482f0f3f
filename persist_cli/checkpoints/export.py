"""``persist export``: a stage-1 run and its memory adapters as one checkpoint folder that stands alone."""

from __future__ import annotations

import contextlib
import re
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
import yaml

from persist_cli import __version__
from persist_cli.checkpoints.checkpoint import (
    CARD,
    PLAIN,
    Checkpoint,
    base_files,
    empty_backbone,
    find_checkpoint,
    fingerprint,
    load_backbone,
    write_card,
)
from persist_cli.checkpoints.lineage import RECIPE, RECIPES, save_stage_recipes, stage_recipes, training_scenes
from persist_cli.checkpoints.sampling_defaults import SamplingOverrides
from persist_cli.errors import CheckpointError, PersistError, hint
from persist_cli.io.checkpoint_folder import lora_base
from persist_cli.io.files import (
    check_folder,
    empty_folder_aside,
    file_sha256,
    folder_aside,
    read_json,
    read_tensors,
    write_json,
    write_tensors,
    write_text,
)
from persist_cli.recipe import parse_yaml_mapping
from persist_cli.viewing.console import print_json, print_table, say, watched

PRECISIONS = {"float16": torch.float16, "bfloat16": torch.bfloat16, "float32": torch.float32}

SUMS = "SHA256SUMS"

PLACE = "_name_or_path"  # where diffusers once loaded a part from

OF_RUNS = {CARD, RECIPE, SUMS}  # at the top of a checkpoint folder; an export makes its own


@dataclass(frozen=True)
class ExportPlan:
    """The options of ``persist export``; see its help."""

    checkpoint: Path
    runs: Sequence[str]
    dtype: str
    default: str | None
    sampling: SamplingOverrides


def run_export(plan: ExportPlan, out: Path, json: bool) -> None:
    """Write the checkpoint folder, whole or not at all, and say what is in it.

    Raises:
        PersistError: one line for whatever does not fit, and when ``out`` exists.
    """
    if plan.dtype not in PRECISIONS:
        raise PersistError(f"unknown dtype {plan.dtype!r}; {hint(plan.dtype, PRECISIONS)}")
    if out.exists():
        raise PersistError(f"{out}: exists already; choose another --out")
    check_folder(out)
    base = find_checkpoint(plan.checkpoint)
    parts = adapter_parts(base, plan.runs)
    default = default_of(base, parts, plan.default)
    sampling = chosen_sampling(base, plan)
    scenes = training_scenes(base)
    for part in parts.values():
        scenes |= training_scenes(part.checkpoint)
    said = {"dtype": plan.dtype, "default_adapter": default, "sampling": sampling}
    with folder_aside(out) as folder:
        card = write_checkpoint(folder, base, parts, PRECISIONS[plan.dtype])
        write_card(folder, card | said | {"exported_by": __version__}, scenes)
        files = write_sums(folder)
    show(out, {"fingerprint": card["fingerprint"]} | said, files, json)


def default_of(base: Checkpoint, parts: dict[str, AdapterExport], asked: str | None) -> str | None:
    """The adapter that is meant when none is named: the one asked for, the checkpoint's, or the only one."""
    if asked is None:
        return base.default if base.default in parts else next(iter(parts)) if len(parts) == 1 else None
    if asked not in parts:
        raise CheckpointError(f"no adapter {asked!r} to be the default; {hint(asked, parts, 'there are')}")
    return asked


def chosen_sampling(base: Checkpoint, plan: ExportPlan) -> dict[str, Any] | None:
    """How the card says to sample: as asked for, else as the checkpoint's; ``None`` when neither says anything.

    Raises:
        PersistError: when the backbone cannot sample so.
    """
    if base.sampling is None and not plan.sampling.given():
        return None
    sampling = plan.sampling.over(base.sampling)
    empty_backbone(base).check_sampling(sampling)
    return asdict(sampling)


def write_checkpoint(
    folder: Path, base: Checkpoint, parts: dict[str, AdapterExport], dtype: torch.dtype
) -> dict[str, Any]:
    """Write base, adapters and recipes into the folder, weights in this precision; returns what the card must say."""
    with whole_base(base, folder) as home:
        return _write_checkpoint(folder, home, base, parts, dtype)


@contextlib.contextmanager
def whole_base(base: Checkpoint, beside: Path) -> Iterator[Path]:
    """A folder with all of a base's own files; that of LoRA, merged, is made beside and removed again."""
    if lora_base(base.base_folder) is None:
        yield base.base_folder
        return
    with empty_folder_aside(beside) as folder:
        load_backbone(base).save_base(folder)
        yield folder


def _write_checkpoint(
    folder: Path, home: Path, base: Checkpoint, parts: dict[str, AdapterExport], dtype: torch.dtype
) -> dict[str, Any]:
    own = [path for path in base_files(home, "*") if belongs(path.relative_to(home))]
    jobs = [(path, folder / path.relative_to(home)) for path in own]
    for name, part in parts.items():
        files = sorted(path for path in part.folder.glob("[!.]*") if path.is_file())
        jobs += [(path, folder / "adapters" / name / path.name) for path in files]
    for source, target in watched(jobs, "export", "file"):
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            convert(source, target, dtype) if source.suffix == ".safetensors" else copy(source, target)
        except OSError as error:  # a run that still trains clears its old checkpoints away; a disk fills up
            raise CheckpointError(f"{source}: cannot be exported ({error.strerror or error})") from error
    save_stage_recipes(folder, known_recipes(base, parts))
    return {"backbone": base.backbone, "settings": base.settings, "fingerprint": fingerprint(folder)}


def belongs(path: Path) -> bool:
    """Whether a file of a base is the backbone's, by its path in the folder: not one that every export makes anew."""
    hidden = any(part.startswith(".") for part in path.parts)
    return str(path) not in OF_RUNS and path.parts[0] != RECIPES and not hidden


def copy(source: Path, target: Path) -> None:
    """Copy a file; a configuration of diffusers without the folder that it was loaded from."""
    values = read_json(source) if source.suffix == ".json" else None
    if not isinstance(values, dict) or PLACE not in values:
        shutil.copyfile(source, target)
        return
    write_json(target, {key: value for key, value in values.items() if key != PLACE})


def convert(source: Path, target: Path, dtype: torch.dtype) -> None:
    """Write a weight file in another precision; whole numbers stay what they are.

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


def write_sums(folder: Path) -> dict[str, dict[str, Any]]:
    """Write ``SHA256SUMS`` for ``sha256sum -c``; returns size and hash of every file by its path in the folder."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    table = {
        path.relative_to(folder).as_posix(): {"bytes": path.stat().st_size, "sha256": file_sha256(path)}
        for path in files
    }
    write_text(folder / SUMS, "".join(f"{each['sha256']}  {name}\n" for name, each in table.items()))
    return table


def show(out: Path, card: dict[str, Any], files: dict[str, dict[str, Any]], json: bool) -> None:
    """Print the files with their sizes."""
    total = sum(each["bytes"] for each in files.values())
    if json:
        print_json({"folder": str(out), **card, "bytes": total, "files": files})
        return
    rows = [(name, f"{each['bytes']:,}") for name, each in files.items()]
    print_table(str(out), ("file", "bytes"), [*rows, ("all", f"{total:,}")])
    say(f"{total / 1e6:.1f} MB, weights in {card['dtype']}; check them with: cd {out} && sha256sum -c {SUMS}")


ADAPTERS = "adapters"  # the folder of their recipes

NAMED = re.compile(r"(?P<name>[A-Za-z0-9][A-Za-z0-9_-]*)=(?P<run>.+)")


@dataclass(frozen=True)
class AdapterExport:
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


def adapter_parts(base: Checkpoint, runs: Sequence[str]) -> dict[str, AdapterExport]:
    """The base's own adapters and those of the runs, by the names that they get.

    Args:
        base: whose backbone is exported.
        runs: ``RUN``, whose adapters keep their names, or ``NAME=RUN``.

    Raises:
        CheckpointError: for an adapter of another base, and for one name twice.
    """
    parts = {name: AdapterExport(base, name) for name in base.adapters}
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


def _parts_of_run(text: str) -> dict[str, AdapterExport]:
    match = None if Path(text).exists() else NAMED.fullmatch(text)
    found = find_checkpoint(Path(match["run"] if match else text))
    if not found.adapters:
        raise CheckpointError(f"{found.folder}: has no memory adapter; name stage-2 runs after the CHECKPOINT")
    if match is None:
        return {name: AdapterExport(found, name) for name in found.adapters}
    if len(found.adapters) > 1:
        raise CheckpointError(f"{found.folder}: NAME=RUN names one adapter, there are {', '.join(found.adapters)}")
    if match["name"] == PLAIN:
        raise CheckpointError(f"{text}: {PLAIN!r} is the base without an adapter; choose another name")
    return {match["name"]: AdapterExport(found, next(iter(found.adapters)))}


def known_recipes(base: Checkpoint, parts: dict[str, AdapterExport]) -> dict[str, str]:
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
