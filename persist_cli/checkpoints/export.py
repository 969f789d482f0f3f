"""``persist export``: a stage-1 run and its memory adapters as one checkpoint folder that stands alone."""

from __future__ import annotations

import contextlib
import dataclasses
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import torch
from safetensors import SafetensorError

from persist_cli import __version__
from persist_cli.api.backbone import Backbone, Sampling
from persist_cli.api.checkpoint import CODEC_ALONE, GUIDE, PLAIN, Checkpoint, find_checkpoint, lora_base, read_card
from persist_cli.api.inference import SamplingOverrides
from persist_cli.api.scene import Scene
from persist_cli.api.training_scenes import TrainingScenes
from persist_cli.checkpoints.exported_files import (
    convert,
    copy_network,
    copy_part,
    is_copied,
    print_files,
    summed_files,
    without_absolute_paths,
)
from persist_cli.checkpoints.guides import check_guide, guide_files
from persist_cli.checkpoints.lineage import (
    ADAPTERS,
    MEMORY_FILE,
    adapter_recipe,
    save_stage_recipes,
    stage_recipes,
    training_scenes,
)
from persist_cli.checkpoints.load import (
    adapter_memory,
    check_noise,
    empty_backbone,
    fresh_on_codec,
    is_codec_alone,
    load_backbone,
    takes_codec_alone,
    warn_of_plain,
)
from persist_cli.checkpoints.save import base_files, fingerprint, hash_weights, write_card
from persist_cli.checkpoints.scene_models import BESIDE, PACKAGED, find_scene_model, is_scene_model, write_scene_card
from persist_cli.errors import CheckpointError, PersistError, hint
from persist_cli.io.files import (
    check_folder,
    empty_folder_aside,
    folder_aside,
    write_json,
)
from persist_cli.io.sha256sums import write_sums
from persist_cli.output.console import busy, watched
from persist_cli.plugins import load_plugin
from persist_cli.policies.trained import find_policy, is_policy, write_policy_card

PRECISIONS: Final = {"float16": torch.float16, "bfloat16": torch.bfloat16, "float32": torch.float32}

NAMED_RUN: Final = re.compile(r"(?P<name>[A-Za-z0-9][A-Za-z0-9_-]*)=(?P<run>.+)")


@dataclass(frozen=True, kw_only=True)
class ExportPlan:
    """The options of ``persist export``; see its help."""

    checkpoint: Path
    runs: Sequence[str]
    dtype: str
    default: str | None
    sampling: SamplingOverrides
    protocol_sampling: Mapping[str, SamplingOverrides] = field(default_factory=dict)
    codec: bool = False
    guide: Path | None = None

    def check_options(self, network: str) -> None:
        """Raise ``PersistError`` when adapters, a sampling or a guide are named for a network that has none."""
        if self.runs or self.default or self.sampling.requested() or self.protocol_sampling or self.guide:
            raise PersistError(
                f"{self.checkpoint}: {network} has no adapters and no sampling; give --dtype and --out alone"
            )


@dataclass(frozen=True)
class AdapterSource:
    """An adapter to export.

    Args:
        checkpoint: the checkpoint that has the adapter.
        adapter: the name of the adapter there.
    """

    checkpoint: Checkpoint
    adapter: str

    @property
    def folder(self) -> Path:
        """The folder of the adapter's files."""
        return self.checkpoint.adapter_folder(self.adapter)


def run_export(plan: ExportPlan, out: Path, json: bool) -> None:
    """Write the checkpoint folder, whole or not at all, and print a table of its files.

    Raises:
        PersistError: when ``out`` exists or when checkpoint, runs and options do not fit together.
    """
    if plan.dtype not in PRECISIONS:
        raise PersistError(f"unknown dtype {plan.dtype!r}; {hint(plan.dtype, PRECISIONS)}")
    if out.exists():
        raise PersistError(f"{out}: exists already; choose another --out")
    check_folder(out)
    if not plan.codec and is_policy(plan.checkpoint):
        export_policy(plan, out, json)
        return
    if not plan.codec and is_scene_model(plan.checkpoint):
        export_scene_model(plan, out, json)
        return
    base = find_checkpoint(plan.checkpoint)
    if plan.codec or is_codec_alone(base):
        export_codec(plan, base, out, json)
        return
    adapters = _find_adapters(base, plan.runs)
    base = _sampled_as(adapters, base, plan.sampling)
    guide = find_checkpoint(plan.guide) if plan.guide else None
    if guide is not None:
        check_guide(guide, base)
    defaults = {
        "dtype": plan.dtype,
        "default_adapter": _default_adapter(base, adapters, plan.default),
        "sampling": _default_sampling(base, plan),
    }
    protocols = _protocol_sampling(base, plan)
    defaults |= {"protocol_sampling": protocols} if protocols else {}
    defaults |= _guide_json(base, guide)
    scenes = training_scenes(base)
    for checkpoint in (*(adapter.checkpoint for adapter in adapters.values()), *([guide] if guide else [])):
        scenes |= training_scenes(checkpoint)
    with folder_aside(out) as folder:
        with _merged_base(base, folder) as home:
            files = guide_files(guide, home) if guide else {}
            _write_checkpoint(folder, home, adapters, files, PRECISIONS[plan.dtype])
        save_stage_recipes(folder, _recipes(base, adapters))
        written = _write_card(folder, base, defaults, scenes)
    print_files(out, {"fingerprint": written} | defaults, summed_files(out), json)


def export_codec(plan: ExportPlan, base: Checkpoint, out: Path, json: bool) -> None:
    """Write the codec of a world model, as a base for other video models, and print a table of its files.

    Raises:
        PersistError: when there is none, or options of adapters and sampling are given.
    """
    plan.check_options("a codec")
    if base.settings.get("pretrained") or lora_base(base.base_folder) is not None:
        raise PersistError(
            f"{plan.checkpoint}: its codec is that of pretrained weights; a recipe names those as "
            "backbone.settings.pretrained"
        )
    if not takes_codec_alone(base):
        raise PersistError(f"{plan.checkpoint}: backbone {base.backbone!r} has no codec that stands alone")
    defaults = {"dtype": plan.dtype, CODEC_ALONE: True}
    with folder_aside(out) as folder:
        with empty_folder_aside(folder) as home:
            with busy("loading the codec"), torch.random.fork_rng(devices=[]):
                torch.manual_seed(0)
                _save_base(fresh_on_codec(base, {}), home)
            _write_checkpoint(folder, home, {}, {}, PRECISIONS[plan.dtype])
        save_stage_recipes(
            folder, {name: text for name, text in _recipes(base, {}).items() if name.startswith("codec")}
        )
        written = _write_card(folder, base, defaults, training_scenes(base))
    print_files(out, {"fingerprint": written} | defaults, summed_files(out), json)


def _write_card(folder: Path, base: Checkpoint, defaults: Mapping[str, Any], scenes: TrainingScenes) -> str:
    """Write card and ``SHA256SUMS`` of an export, and return its fingerprint."""
    with busy("hashing the files"):
        hashes = hash_weights(folder)
        written = fingerprint(hashes)
        card = {"backbone": base.backbone, "settings": base.settings, "fingerprint": written}
        write_card(folder, {**card, **defaults, "exported_by": __version__}, scenes)
        write_sums(folder, hashes)
    return written


def export_policy(plan: ExportPlan, out: Path, json: bool) -> None:
    """Write a trained policy as a folder that stands alone, and print a table of its files.

    Raises:
        PersistError: when options of world models are given.
    """
    policy = find_policy(plan.checkpoint)
    with _network_folder(plan, policy.folder, "a policy", out) as folder:
        write_policy_card(folder, policy.plugin, policy.settings, policy.training_scenes)
    print_files(out, {"policy": policy.plugin, "dtype": plan.dtype}, summed_files(out), json)


def export_scene_model(plan: ExportPlan, out: Path, json: bool) -> None:
    """Write a trained model of scenes as a folder that stands alone, and print a table of its files.

    Raises:
        PersistError: when options of world models are given.
    """
    model = find_scene_model(plan.checkpoint)
    with _network_folder(plan, model.folder, "a model of scenes", out) as folder:
        write_scene_card(folder, model.plugin, model.settings, model.stage, model.training_scenes)
    print_files(out, {"scene": model.plugin, "dtype": plan.dtype}, summed_files(out), json)


@contextlib.contextmanager
def _network_folder(plan: ExportPlan, source: Path, network: str, out: Path) -> Iterator[Path]:
    """The folder of an exported network, with its weights and recipe; the block writes its card."""
    plan.check_options(network)
    with folder_aside(out) as folder:
        copy_network(source, folder, PRECISIONS[plan.dtype])
        yield folder
        write_sums(folder)


def _find_adapters(base: Checkpoint, runs: Sequence[str]) -> dict[str, AdapterSource]:
    """The adapters of the base and of the runs, by the names that they get in the export.

    Args:
        base: the checkpoint whose backbone is exported.
        runs: texts ``RUN``, whose adapters keep their names, or ``NAME=RUN``.

    Raises:
        CheckpointError: when an adapter is of another base, or two get one name.
    """
    adapters = {name: AdapterSource(base, name) for name in base.adapters}
    for text in runs:
        for name, adapter in _adapters_of_run(text).items():
            folder = adapter.checkpoint.folder
            if adapter.checkpoint.fingerprint != base.fingerprint:
                raise CheckpointError(f"{folder}: its adapter is of another base than {base.folder}")
            if name in adapters:
                raise CheckpointError(
                    f"{folder}: adapter {name!r} is there already, from {adapters[name].checkpoint.folder}"
                    f"; name this one, as in {name}-other={text.removeprefix(f'{name}=')}"
                )
            adapters[name] = adapter
    return adapters


def _adapters_of_run(text: str) -> dict[str, AdapterSource]:
    match = None if Path(text).exists() else NAMED_RUN.fullmatch(text)
    run = find_checkpoint(Path(match["run"] if match else text))
    if not run.adapters:
        raise CheckpointError(f"{run.folder}: has no memory adapter; name stage-2 runs after the CHECKPOINT")
    if match is None:
        return {name: AdapterSource(run, name) for name in run.adapters}
    if len(run.adapters) > 1:
        raise CheckpointError(f"{run.folder}: NAME=RUN names one adapter, there are {', '.join(run.adapters)}")
    if match["name"] == PLAIN:
        raise CheckpointError(f"{text}: {PLAIN!r} is the base without an adapter; choose another name")
    return {match["name"]: AdapterSource(run, next(iter(run.adapters)))}


def _default_adapter(base: Checkpoint, adapters: dict[str, AdapterSource], requested: str | None) -> str | None:
    """The adapter to use when none is named: the requested one, else the checkpoint's default, else the only one."""
    if requested is None:
        return base.default if base.default in adapters else next(iter(adapters)) if len(adapters) == 1 else None
    if requested not in adapters:
        raise CheckpointError(f"no adapter {requested!r} to be the default; {hint(requested, adapters, 'there are')}")
    return requested


def _sampled_as(adapters: Mapping[str, AdapterSource], base: Checkpoint, requested: SamplingOverrides) -> Checkpoint:
    """The base with these adapters and the sampling that they ask for: a distilled one has its own, on any base.

    Raises:
        CheckpointError: when they ask for several and the options leave it open.
    """
    samplings = {name: adapter.checkpoint.sampling_with(requested) for name, adapter in adapters.items()}
    if len(set(samplings.values())) > 1:
        words = ", ".join(f"{name} {sampling.words}" for name, sampling in samplings.items())
        raise CheckpointError(
            f"an export has one sampling, its adapters ask for several: {words}; give --steps, --sampler and what else "
            "they differ in"
        )
    if not adapters:
        return base
    warn_of_plain(base, next(iter(samplings.values())))
    asked = next(iter(adapters.values())).checkpoint
    return dataclasses.replace(
        base,
        adapters={name: adapter.folder for name, adapter in adapters.items()},
        sampling=asked.sampling,
        protocol_sampling=asked.protocol_sampling,
    )


def _default_sampling(base: Checkpoint, plan: ExportPlan) -> dict[str, Any] | None:
    """The default sampling of the export, ``None`` when neither the options nor the checkpoint have one.

    Raises:
        PersistError: when the backbone cannot sample so.
    """
    if base.sampling is None and not plan.sampling.requested():
        return None
    sampling = base.sampling_with(plan.sampling)
    _check_sampling(base, plan, sampling)
    return asdict(sampling)


def _check_sampling(base: Checkpoint, plan: ExportPlan, sampling: Sampling) -> None:
    """Raise ``PersistError`` when the backbone, with the guide that it gets, cannot sample so."""
    backbone = empty_backbone(base)
    backbone.guide_folder = plan.guide or backbone.guide_folder
    backbone.check_sampling(sampling)
    check_noise(sampling, [base])


def _guide_json(base: Checkpoint, guide: Checkpoint | None) -> dict[str, Any]:
    """What a card says of the guide: which it is, by its fingerprint; nothing where there is none."""
    kept = read_card(base.base_folder).get(GUIDE)
    written = {"fingerprint": guide.fingerprint} if guide is not None else kept
    return {} if written is None else {GUIDE: written}


def _protocol_sampling(base: Checkpoint, plan: ExportPlan) -> dict[str, dict[str, Any]]:
    """The sampling of each protocol that has one of its own: that of the checkpoint's card, with the options.

    Raises:
        PersistError: when the backbone cannot sample so.
    """
    common = dataclasses.replace(base, sampling=base.sampling_with(plan.sampling))
    samplings = {
        protocol: common.sampling_with(plan.protocol_sampling.get(protocol, SamplingOverrides()), protocol)
        for protocol in (*base.protocol_sampling, *plan.protocol_sampling)
    }
    for sampling in samplings.values():
        _check_sampling(base, plan, sampling)
    return {protocol: asdict(sampling) for protocol, sampling in samplings.items()}


def _write_checkpoint(
    folder: Path, home: Path, adapters: dict[str, AdapterSource], guide: dict[str, Path], dtype: torch.dtype
) -> None:
    """Write a base's own files, its guide and adapters into the folder.

    Args:
        folder: the folder.
        home: where the base's own files are.
        adapters: by the names that they get.
        guide: files of its guide by name; without any that of the base is copied, where it has one.
        dtype: precision of the weights.
    """
    paths = [path.relative_to(home) for path in base_files(home, "*")]
    paths = [path for path in paths if not (guide and path.parts[0] == GUIDE)]
    jobs = [(home / path, folder / path) for path in paths if is_copied(path)]
    jobs += [(path, folder / GUIDE / name) for name, path in guide.items()]
    for name, adapter in adapters.items():
        files = sorted(path for path in adapter.folder.glob("[!.]*") if path.is_file())
        jobs += [(path, folder / ADAPTERS / name / path.name) for path in files]
    for source, target in watched(jobs, "export", "files"):
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            convert(source, target, dtype) if source.suffix == ".safetensors" else copy_part(source, target)
        except OSError as error:  # a run that still trains clears its old checkpoints away; a disk fills up
            place = error.filename or target
            raise CheckpointError(f"{place}: cannot be exported ({error.strerror or error})") from error
    for name, adapter in adapters.items():
        _put_scene_model_beside(adapter, folder / ADAPTERS / name, dtype)


def _put_scene_model_beside(adapter: AdapterSource, folder: Path, dtype: torch.dtype) -> None:
    """Write the model that imagines in an adapter's scenes beside it, because its place is of one machine alone.

    Raises:
        CheckpointError: when that model is not there.
    """
    memory = adapter_memory(adapter.checkpoint, adapter.adapter)
    place = memory.settings.get("model")
    if not issubclass(load_plugin("memory", memory.name), Scene) or place in (None, PACKAGED):
        return
    model, beside = find_scene_model(place), folder / BESIDE
    beside.mkdir()
    copy_network(model.folder, beside, dtype)
    write_scene_card(beside, model.plugin, model.settings, model.stage, model.training_scenes)
    write_sums(beside)
    write_json(folder / MEMORY_FILE, asdict(replace(memory, settings=memory.settings | {"model": BESIDE})))


def _save_base(backbone: Backbone, folder: Path) -> None:
    try:
        backbone.save_base(folder)
    except SafetensorError as error:  # as where a disk is full
        raise CheckpointError(f"{folder}: cannot be written ({error})") from error


@contextlib.contextmanager
def _merged_base(base: Checkpoint, beside: Path) -> Iterator[Path]:
    """A folder with all of a base's own files; where LoRA has to be merged, it is made aside and removed again."""
    if lora_base(base.base_folder) is None:
        yield base.base_folder
        return
    with empty_folder_aside(beside) as folder:
        with busy("merging LoRA into its base"):
            _save_base(load_backbone(base), folder)
        yield folder


def _recipes(base: Checkpoint, adapters: dict[str, AdapterSource]) -> dict[str, str]:
    """Texts of the recipes behind an export by file name: those of the base's stages and ``adapters/NAME.yaml``.

    Of absolute paths in them only the last part is kept, because they lead nowhere on another machine.
    """
    recipes = stage_recipes(base.base_folder)
    for name, adapter in adapters.items():
        text = adapter_recipe(adapter.checkpoint, adapter.adapter)
        recipes |= {f"{ADAPTERS}/{name}.yaml": text} if text is not None else {}
    return {name: without_absolute_paths(text, name) for name, text in recipes.items()}
