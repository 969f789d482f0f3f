"""diffusers' transformer, VAE and scheduler, from which a model is built, and the files of a trained model.

Pretrained parts are in a local directory of diffusers' layout or in a repository of the hub.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from persist_backbones.cogvideox.codec import spatial_compression
from persist_backbones.cogvideox.config import PRESETS, CogVideoXSettings
from persist_backbones.cogvideox.diffusion import scheduler_of
from persist_backbones.diffusers_models import (
    LORA_ADAPTER_METADATA_KEY,
    LORA_WEIGHT_NAME_SAFE,
    AutoencoderKLCogVideoX,
    CogVideoXDDIMScheduler,
    CogVideoXResnetBlock3D,
    CogVideoXTransformer3DModel,
)
from persist_cli.api.meta_device import without_weights
from persist_cli.errors import CheckpointError
from persist_cli.io.files import follow_umask, load_exactly, read_json, read_tensors, write_tensors
from persist_cli.io.hub import hub_obstacle

SUBFOLDERS = {
    "transformer": CogVideoXTransformer3DModel,
    "vae": AutoencoderKLCogVideoX,
    "scheduler": CogVideoXDDIMScheduler,
}
WEIGHTS = "diffusion_pytorch_model.safetensors"  # the weights of a part in a single file
WORLD = "world.safetensors"  # of a trained model: all that diffusers' parts do not have
REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")
PUBLISHERS = ("zai-org", "THUDM")  # of the same repositories, now and before
PUBLISHED = {  # preset of each of their repositories
    "CogVideoX-2b": "2b",
    "CogVideoX-5b": "5b",
    "CogVideoX-5b-I2V": "5b-i2v",
    "CogVideoX1.5-5B": "1.5-5b",
    "CogVideoX1.5-5B-I2V": "1.5-5b-i2v",
}
INITIAL_LOG_VARIANCE = -6.0  # of fresh latents, whose noise must not hide them
PREFIX = "transformer."  # of the names in a pipeline's LoRA file
DOWN, UP = ".lora_A.weight", ".lora_B.weight"
LEVEL = "image_level."  # begins the names of the embedding of noise levels, which starts at zero
SAMPLED = 256  # values of a tensor that enter its digest
# of denoising steps, as CogVideoX is sampled: others begin with noise at a level where training has seen less of it,
# or step to other levels than those of the next prediction; diffusers takes another one where a file names none
SPACING = {"timestep_spacing": "trailing"}
MAY_BE_ZERO = {"dropout", "freq_shift", "ofs_embed_dim", "norm_eps", "shift_factor"}  # of numbers in configurations


@dataclass(frozen=True)
class DiffusersParts:
    """diffusers' transformer, autoencoder and scheduler of one model."""

    transformer: CogVideoXTransformer3DModel
    vae: AutoencoderKLCogVideoX
    scheduler: CogVideoXDDIMScheduler


def starting_parts(settings: CogVideoXSettings) -> DiffusersParts:
    """Return the parts that a model of these settings begins with.

    On the meta device nothing is downloaded: missing weights get the sizes of their published name, else the preset's.
    """
    if settings.pretrained is None:
        return make_parts(settings)
    folder = folder_here(settings.pretrained) if on_meta_device() else pretrained_folder(settings.pretrained)
    if folder is not None:
        parts = load_parts(folder)
    else:
        check_name(settings.pretrained)
        preset: Any = published_preset(settings.pretrained) or settings.preset
        parts = make_parts(dataclasses.replace(settings, preset=preset, transformer={}, vae={}))
    check_own_sizes(parts, settings)
    return parts


def check_own_sizes(parts: DiffusersParts, settings: CogVideoXSettings) -> None:
    """Raise ``CheckpointError`` when the settings have another size or option than the pretrained weights."""
    for name, part in (("transformer", parts.transformer), ("vae", parts.vae)):
        for key, value in getattr(settings, name).items():
            own = part.config.get(key)
            if (list(own) if isinstance(own, tuple) else own) != (list(value) if isinstance(value, tuple) else value):
                raise CheckpointError(
                    f"backbone.settings.{name}.{key}: {settings.pretrained} has {own!r}, not {value!r}; leave it out"
                )


def make_parts(settings: CogVideoXSettings) -> DiffusersParts:
    """Make freshly initialised parts of the settings' preset and sizes."""
    preset = PRESETS[settings.preset]
    image_size = {"sample_height": settings.height, "sample_width": settings.width}
    vae = make_part("vae", preset["vae"] | image_size | settings.vae)
    initialize(vae)
    spatial = spatial_compression(vae)
    size = {
        "sample_height": settings.height // spatial,
        "sample_width": settings.width // spatial,
        "sample_frames": settings.frames,
    }
    transformer = make_part("transformer", preset["transformer"] | size | settings.transformer)
    prediction = {"prediction_type": settings.prediction} if settings.prediction else {}
    return DiffusersParts(transformer, vae, make_part("scheduler", preset["scheduler"] | prediction))


def initialize(vae: AutoencoderKLCogVideoX) -> None:
    """Initialise a fresh VAE: residual blocks are the identity and latents have little noise."""
    with torch.no_grad():
        vae.encoder.conv_out.conv.bias[vae.config.latent_channels :] = INITIAL_LOG_VARIANCE
        for module in vae.modules():
            if isinstance(module, CogVideoXResnetBlock3D):
                module.conv2.conv.weight.zero_()
                module.conv2.conv.bias.zero_()


def load_parts(folder: Path) -> DiffusersParts:
    """Load the parts of a diffusers directory with ``transformer/``, ``vae/`` and ``scheduler/``, or only their shapes.

    Raises:
        CheckpointError: one line when a part is missing, corrupt or does not fit its configuration.
    """
    return DiffusersParts(*(load_part(folder, name) for name in SUBFOLDERS))


def on_meta_device() -> bool:
    """Whether torch's default device is the meta device, so that models have shapes only and no weights are read."""
    return torch.empty(0).is_meta


def make_part(name: str, config: dict[str, Any]) -> Any:
    """Make a fresh part of this configuration; on the meta device only its shapes.

    Args:
        name: a key of ``SUBFOLDERS``.
        config: keyword arguments of the part's class.

    Raises:
        CheckpointError: one line for a configuration that diffusers refuses, and for sizes below 1.
    """
    if name == "scheduler":  # its tables are no weights, and needed on the meta device too
        with torch.device("cpu"):
            return _construct(name, config)
    part = _construct(name, config)
    return nn.Module.to(part, "meta") if on_meta_device() else part  # diffusers' own ``to`` imports all its hooks


def _construct(name: str, config: dict[str, Any]) -> Any:
    """Make a part on the default device; where that is the meta device, its tables of positions are on the CPU."""
    _check_sizes(name, config)
    try:
        with _TablesOnCpu():
            return SUBFOLDERS[name](**config)
    except (TypeError, ValueError, IndexError, ArithmeticError, NameError) as error:
        raise CheckpointError(f"diffusers cannot make a {name} of these settings ({_cause(error)})") from error


class _TablesOnCpu(TorchFunctionMode):
    """Makes ranges of numbers on the CPU, for which torch would import its compiler on the meta device."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None) -> Any:
        kwargs = kwargs or {}
        if func is torch.arange and kwargs.get("device") is None:
            kwargs = kwargs | {"device": "cpu"}
        return func(*args, **kwargs)


def save_parts(parts: DiffusersParts, folder: Path) -> None:
    """Write diffusers' parts, each loadable by diffusers alone."""
    parts.transformer.save_pretrained(folder / "transformer")
    parts.vae.save_pretrained(folder / "vae")
    parts.scheduler.save_pretrained(folder / "scheduler")
    for name in SUBFOLDERS:
        follow_umask(folder / name)


def save_world(transformer: nn.Module, prompt: Tensor, folder: Path) -> None:
    """Write ``world.safetensors``: widening, interactions and the prompt's embedding."""
    widening = {name: value for name, value in transformer.state_dict().items() if not name.startswith("base.")}
    write_tensors(folder / WORLD, widening | {"prompt": prompt})


def load_world(transformer: nn.Module, folder: Path) -> Tensor:
    """Load what ``save_world`` wrote, and return the prompt's embedding in the transformer's precision."""
    path = folder / WORLD
    tensors, _ = read_tensors(path)
    prompt = tensors.pop("prompt", None)
    if prompt is None:
        raise CheckpointError(f"{path}: no prompt embedding in it")
    widening = {name: value for name, value in transformer.state_dict().items() if not name.startswith("base.")}
    fresh = {name: value for name, value in widening.items() if name.startswith(LEVEL) and name not in tensors}
    tensors |= {name: torch.zeros(value.shape) for name, value in fresh.items()}  # a base that was told no noise levels
    load_exactly(transformer, tensors, set(widening), path)
    return prompt.to(next(transformer.parameters()).dtype)


@torch.no_grad()
def merge_lora(transformer: CogVideoXTransformer3DModel, folder: Path, check: bool) -> None:
    """Add the LoRA that ``save_lora`` wrote to the weights on which it was trained.

    Args:
        transformer: diffusers' transformer with those weights.
        folder: folder of the LoRA file.
        check: whether to verify by a digest that these are the weights of its training.

    Raises:
        CheckpointError: when the file is missing or corrupt, or does not fit these weights.
    """
    path = folder / LORA_WEIGHT_NAME_SAFE
    tensors, metadata = read_tensors(path)
    scale = _scale(metadata, path)
    if check and metadata.get("digest") != weights_digest(transformer):
        raise CheckpointError(f"{path}: was trained on other weights than those that it is to change")
    weights = dict(transformer.named_parameters())
    for name in sorted(name for name in tensors if name.endswith(DOWN)):
        module = name.removeprefix(PREFIX).removesuffix(DOWN)
        down, up = tensors[name], tensors.get(name.removesuffix(DOWN) + UP)
        weight = weights.get(f"{module}.weight")
        if up is None or weight is None or weight.shape != (up.shape[0], down.shape[1]):
            raise CheckpointError(f"{path}: does not fit this model at {module!r}")
        weight.add_((scale * up.double() @ down.double()).to(weight))


def weights_digest(transformer: CogVideoXTransformer3DModel) -> str:
    """Return a hash of names, shapes and some values of each weight, which differs between models."""
    digest = hashlib.sha256()
    for name, tensor in sorted(transformer.state_dict().items()):  # tables of positions too
        values = tensor.detach().flatten()
        sample = values[:: max(1, len(values) // SAMPLED)].float().cpu().contiguous()
        digest.update(f"{name} {tuple(tensor.shape)}".encode() + sample.numpy().tobytes())
    return digest.hexdigest()


def pretrained_folder(name: str) -> Path:
    """Return the local directory of this name, else the directory of the hub's repository in its cache.

    Missing files of transformer, VAE and scheduler are downloaded; a text encoder never is.

    Raises:
        CheckpointError: one line when there is no such directory, and the repository cannot be downloaded.
    """
    folder = folder_here(name)
    if folder is not None and (not _of_the_hub(name) or not any(missing_files(folder / part) for part in SUBFOLDERS)):
        return folder
    check_name(name)
    obstacle = hub_obstacle()
    if obstacle:
        parts = " ".join(f"'{part}/*'" for part in SUBFOLDERS)
        raise CheckpointError(
            f"{name}: no such directory, not whole in the hub's cache, and the hub: {obstacle}; give a local diffusers "
            f"directory, or fetch it elsewhere: hf download {name} --include {parts}"
        )
    return _download(name)


def folder_here(name: str) -> Path | None:
    """Return the local directory of this name, else the repository in the hub's cache, else ``None``.

    The cache may hold a published model under either name of its publisher. The network is not used.
    """
    from huggingface_hub import errors, snapshot_download

    folder = Path(name).expanduser()
    if folder.is_dir():
        return folder
    if not REPOSITORY.fullmatch(name):
        return None
    model = name.partition("/")[2]
    others = [f"{publisher}/{model}" for publisher in PUBLISHERS] if published_preset(name) else []
    for repository in (name, *others):
        with contextlib.suppress(errors.LocalEntryNotFoundError):
            return Path(snapshot_download(repository, local_files_only=True))
    return None


def missing_files(part: Path) -> list[str]:
    """Return the names of the files of configuration and weights that a part's folder lacks."""
    if part.name == "scheduler":
        wanted = [part / "scheduler_config.json"]
    else:
        wanted = [part / "config.json", *_weight_files(part)]
    return [path.name for path in wanted if not path.is_file()]


def _weight_files(part: Path) -> list[Path]:
    """Return the file or shards that hold a part's weights, whether they are there or not."""
    index = part / "diffusion_pytorch_model.safetensors.index.json"
    names = set(read_json(index)["weight_map"].values()) if index.is_file() else {WEIGHTS}
    return [part / name for name in sorted(names)]


def published_preset(name: str) -> str | None:
    """Return the preset with the sizes of a published model's repository, ``None`` for any other name."""
    owner, _, model = name.partition("/")
    return PUBLISHED.get(model) if owner in PUBLISHERS else None


def origin_of(pretrained: str | None) -> dict[str, str]:
    """Return the setting ``pretrained`` with an absolute path, or no setting without pretrained weights."""
    if not pretrained:
        return {}
    return {"pretrained": str(Path(pretrained).resolve()) if Path(pretrained).is_dir() else pretrained}


def check_name(name: str) -> None:
    """Raise ``CheckpointError`` for a name that cannot be a repository of the hub (and is no local directory)."""
    if not REPOSITORY.fullmatch(name):
        raise CheckpointError(f"{name}: no such directory, and not the name of a repository on the hub (owner/model)")


def load_part(folder: Path, name: str) -> Any:
    """Load one part of a diffusers directory, a key of ``SUBFOLDERS``; errors as of ``load_parts``."""
    if not (folder / name).is_dir():
        raise CheckpointError(
            f"{folder}: no {name}/ folder; a diffusers CogVideoX directory has {', '.join(SUBFOLDERS)}"
        )
    config = _read_config(folder, name)
    if name == "scheduler":
        config |= SPACING
    if on_meta_device():
        return make_part(name, config)
    missing = missing_files(folder / name)
    if missing:
        raise CheckpointError(f"{folder / name}: no {missing[0]} in it; take a whole copy, its weights as safetensors")
    if name == "scheduler":
        return scheduler_of(SUBFOLDERS[name], config)
    with without_weights():
        part = _construct(name, config)
    _load_weights(part, folder / name)
    return part.eval()


def _load_weights(part: nn.Module, folder: Path) -> None:
    """Load the weights in a part's folder, in one file or in shards, in the precision of a fresh part.

    diffusers' ``from_pretrained`` gives the same, but first draws random weights, and imports what is not used here.

    Raises:
        CheckpointError: when a file is corrupt, or the weights are not those that the part has.
    """
    tensors = {name: tensor for path in _weight_files(folder) for name, tensor in read_tensors(path)[0].items()}
    wanted = part.state_dict()
    if "patch_embed.pos_embedding" not in wanted:
        tensors.pop("patch_embed.pos_embedding", None)  # computed, though some copies have it
    for problem, names in (("lack", set(wanted) - set(tensors)), ("have besides", set(tensors) - set(wanted))):
        if names:
            raise CheckpointError(
                f"{folder}: its weights {problem} {len(names)} tensors of its config.json, first {min(names)!r}; "
                "take a whole copy of both"
            )
    for name, tensor in tensors.items():
        if tensor.shape != wanted[name].shape:
            raise CheckpointError(
                f"{folder}: cannot be loaded ({name!r} has the shape {tuple(tensor.shape)}, config.json wants "
                f"{tuple(wanted[name].shape)})"
            )
    # taken out one by one: every process reads all of a model, and must not hold it in two precisions
    cast = {name: tensors.pop(name).to(wanted[name].dtype) for name in [*tensors]}
    part.load_state_dict(cast, assign=True)


def _read_config(folder: Path, name: str) -> dict[str, Any]:
    try:
        config = SUBFOLDERS[name].load_config(folder, subfolder=name, local_files_only=True)
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{folder / name}: its configuration cannot be read ({_cause(error)})") from error
    if not isinstance(config, dict):
        raise CheckpointError(f"{folder / name}: its configuration is no mapping; take a whole copy")
    return {key: value for key, value in config.items() if not key.startswith("_")}


def _check_sizes(name: str, config: dict[str, Any]) -> None:
    """Raise ``CheckpointError`` for sizes below 1, which torch accepts although such a model cannot run."""
    empty = [key for key, value in config.items() if type(value) is int and value < 1 and key not in MAY_BE_ZERO]
    if empty and name != "scheduler":
        sizes = ", ".join(f"{key} {config[key]}" for key in empty)
        raise CheckpointError(f"diffusers cannot make a {name} of these settings ({sizes}: at least 1)")


def _of_the_hub(name: str) -> bool:
    return not Path(name).expanduser().is_dir()


def _download(name: str) -> Path:
    from huggingface_hub import errors, snapshot_download

    wanted = [f"{part}/*.{kind}" for part in SUBFOLDERS for kind in ("json", "safetensors")]
    try:
        return Path(snapshot_download(name, allow_patterns=wanted))
    except (OSError, ValueError, errors.HfHubHTTPError) as error:
        cause = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise CheckpointError(f"{name}: the hub does not give it ({cause})") from error


def _cause(error: Exception) -> str:
    lines = [line.strip() for line in str(error).strip().splitlines()]
    first = " ".join(lines[: 2 if lines and lines[0].endswith(":") else 1])
    return first or type(error).__name__


def _scale(metadata: dict[str, str], path: Path) -> float:
    try:
        config: dict[str, Any] = json.loads(metadata[LORA_ADAPTER_METADATA_KEY])
        return float(config[f"{PREFIX}lora_alpha"]) / int(config[f"{PREFIX}r"])
    except (KeyError, ValueError, TypeError) as error:
        raise CheckpointError(f"{path}: it does not say its rank and alpha") from error
