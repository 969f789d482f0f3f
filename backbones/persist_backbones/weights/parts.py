"""The parts of a CogVideoX world model: made from a preset or a plain diffusers directory, saved and loaded."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from diffusers import AutoencoderKLCogVideoX, CogVideoXDDIMScheduler, CogVideoXTransformer3DModel
from diffusers.models.autoencoders.autoencoder_kl_cogvideox import CogVideoXResnetBlock3D
from torch import Tensor, nn

from persist_backbones.adapters.adapter import VideoShape
from persist_backbones.clip_shape import clip_shape
from persist_backbones.codec import Codec, check_vae, spatial_compression
from persist_backbones.conditioning import RAY_CHANNELS
from persist_backbones.objective import check_prediction
from persist_backbones.patches import frames_per_token
from persist_backbones.position_tables import fit_positions
from persist_backbones.weights.presets import PRESETS, CogVideoXSettings
from persist_backbones.weights.pretrained import (
    check_name,
    folder_here,
    missing_files,
    pretrained_folder,
    published_preset,
)  # fmt: skip
from persist_backbones.world_transformer import WorldTransformer
from persist_cli.world.errors import CheckpointError
from persist_cli.world.files import read_tensors, write_tensors

SUBFOLDERS = {
    "transformer": CogVideoXTransformer3DModel,
    "vae": AutoencoderKLCogVideoX,
    "scheduler": CogVideoXDDIMScheduler,
}

MAY_BE_ZERO = {"dropout", "freq_shift", "ofs_embed_dim", "norm_eps", "shift_factor"}  # of numbers in configurations
INITIAL_LOG_VARIANCE = -6.0  # of fresh latents: noise that does not drown what has not been learnt yet


@dataclass(frozen=True)
class DiffusersParts:
    """What diffusers brings: transformer, autoencoder and scheduler."""

    transformer: CogVideoXTransformer3DModel
    vae: AutoencoderKLCogVideoX
    scheduler: CogVideoXDDIMScheduler


def starting_parts(settings: CogVideoXSettings) -> DiffusersParts:
    """The parts that a model of these settings begins with.

    A plan asks no network: of weights that are not here it takes the sizes that their name tells, else the preset's.
    """
    if settings.pretrained is None:
        return make_parts(settings)
    if not planning():
        return load_parts(pretrained_folder(settings.pretrained))
    folder = folder_here(settings.pretrained)
    if folder is not None:
        return load_parts(folder)
    check_name(settings.pretrained)
    preset: Any = published_preset(settings.pretrained) or settings.preset
    return make_parts(dataclasses.replace(settings, preset=preset))


def planning() -> bool:
    """Whether what is made now is a plan: torch's default device is the meta device, so no weights are read."""
    return torch.empty(0).is_meta


def make_parts(settings: CogVideoXSettings) -> DiffusersParts:
    """Freshly initialised parts of the settings' preset and sizes."""
    preset = PRESETS[settings.preset]
    shown = {"sample_height": settings.height, "sample_width": settings.width}
    vae = _make_part("vae", preset["vae"] | shown | settings.vae)
    initialize(vae)
    spatial = spatial_compression(vae)
    size = {
        "sample_height": settings.height // spatial,
        "sample_width": settings.width // spatial,
        "sample_frames": settings.frames,
    }
    transformer = _make_part("transformer", preset["transformer"] | size | settings.transformer)
    prediction = {"prediction_type": settings.prediction} if settings.prediction else {}
    return DiffusersParts(transformer, vae, CogVideoXDDIMScheduler(**(preset["scheduler"] | prediction)))


def initialize(vae: AutoencoderKLCogVideoX) -> None:
    """Begin a fresh VAE with residual blocks that are the identity and latents with little noise."""
    with torch.no_grad():
        vae.encoder.conv_out.conv.bias[vae.config.latent_channels :] = INITIAL_LOG_VARIANCE
        for module in vae.modules():
            if isinstance(module, CogVideoXResnetBlock3D):
                module.conv2.conv.weight.zero_()
                module.conv2.conv.bias.zero_()


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
        return _make_part(name, config)
    missing = missing_files(folder / name)
    if missing:
        raise CheckpointError(f"{folder / name}: no {missing[0]} in it; take a whole copy, its weights as safetensors")
    options: dict[str, Any] = {"subfolder": name, "local_files_only": True}
    try:
        if name == "scheduler":
            return SUBFOLDERS[name].from_pretrained(folder, **options)
        with _silent("diffusers.models.modeling_utils"):  # what it warns of is refused below
            part, found = SUBFOLDERS[name].from_pretrained(
                folder, use_safetensors=True, low_cpu_mem_usage=False, output_loading_info=True, **options
            )
    except (OSError, ValueError, RuntimeError, KeyError, TypeError) as error:
        raise CheckpointError(f"{folder / name}: cannot be loaded ({_cause(error)})") from error
    computed = () if config.get("use_learned_positional_embeddings") else ("patch_embed.pos_embedding",)
    _check_all_loaded(folder / name, found, computed)
    return part


@contextlib.contextmanager
def _silent(name: str) -> Iterator[None]:
    """Within the block this logger says nothing."""
    logger = logging.getLogger(name)
    before, logger.disabled = logger.disabled, True
    try:
        yield
    finally:
        logger.disabled = before


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


def _make_part(name: str, config: dict[str, Any]) -> Any:
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


def check_fit(parts: DiffusersParts, settings: CogVideoXSettings) -> None:
    """Raise ``CheckpointError`` when the parts do not work together at the settings' size."""
    check_vae(parts.vae)
    check_prediction(parts.scheduler, settings.prediction)
    check_frames(int(parts.vae.config.temporal_compression_ratio), settings)
    config, vae = parts.transformer.config, parts.vae.config
    unit = spatial_compression(parts.vae) * config.patch_size
    if settings.height % unit or settings.width % unit:
        raise CheckpointError(f"image size {settings.height}x{settings.width} must be a multiple of {unit}")
    if config.in_channels not in (vae.latent_channels, 2 * vae.latent_channels):
        raise CheckpointError(
            f"a transformer of {config.in_channels} channels does not fit a VAE of {vae.latent_channels}"
        )
    if config.ofs_embed_dim and config.ofs_embed_dim != config.time_embed_dim:
        raise CheckpointError(
            f"a transformer whose ofs_embed_dim {config.ofs_embed_dim} is not its time_embed_dim "
            f"{config.time_embed_dim} cannot add one to the other"
        )
    tables = config.use_learned_positional_embeddings or not config.use_rotary_positional_embeddings
    if config.patch_size_t is not None and tables:
        raise CheckpointError("patch_size_t needs rotary positions alone, as CogVideoX 1.5 has them")


def check_frames(temporal: int, settings: CogVideoXSettings) -> None:
    """Raise ``CheckpointError`` when the codec, of this compression in time, cannot code the settings' frames."""
    # diffusers' decoder doubles time in halves and tells a first frame from an odd number of latent frames
    step = 2 * temporal if temporal > 1 else 1
    rule, window = f"{step}n + 1, " if step > 1 else "", (settings.codec_window or (1,))[0]
    if settings.frames < 2 or (settings.frames - 1) % step:
        raise CheckpointError(f"frames must be {rule}at least 2, not {settings.frames}")
    if window < 1 or (window - 1) % step:
        raise CheckpointError(f"codec_window's frames must be {rule}at least 1, not {window}")


def widen(parts: DiffusersParts, settings: CogVideoXSettings) -> WorldTransformer:
    """The transformer with zero-initialised inputs and outputs for RGB-D, cameras and interactions."""
    latents = parts.vae.config.latent_channels
    camera = RAY_CHANNELS * int(parts.vae.config.temporal_compression_ratio)
    slots = (settings.frames - 1) * len(settings.interactions)
    shape = clip_shape(parts.transformer, parts.vae, settings)
    fit_positions(parts.transformer, (shape.padded_frames, shape.height, shape.width))
    seen = camera * shape.token_frames
    return WorldTransformer(parts.transformer, 4 * latents + camera, 2 * latents, slots, seen)


def video_shape(transformer: WorldTransformer, codec: Codec) -> VideoShape:
    """What an adapter must know of the model."""
    config = transformer.base.config
    return VideoShape(
        channels=config.num_attention_heads * config.attention_head_dim,
        camera_channels=transformer.camera_channels,
        time_channels=config.time_embed_dim,
        layers=config.num_layers,
        patch=config.patch_size,
        spatial=codec.spatial,
        temporal=codec.temporal,
        inputs=transformer.in_channels,
        outputs=transformer.out_channels,
        token_frames=frames_per_token(config),
    )


def save_world(transformer: WorldTransformer, prompt: Tensor, folder: Path) -> None:
    """Write what is ours beside diffusers' parts: widening, interactions and the prompt's embedding."""
    own = {name: value for name, value in transformer.state_dict().items() if not name.startswith("base.")}
    write_tensors(folder / "world.safetensors", own | {"prompt": prompt})


def load_world(transformer: WorldTransformer, folder: Path) -> Tensor:
    """Take what ``save_world`` wrote, in whatever precision; returns the prompt's embedding in the transformer's."""
    path = folder / "world.safetensors"
    tensors, _ = read_tensors(path)
    prompt = tensors.pop("prompt", None)
    if prompt is None:
        raise CheckpointError(f"{path}: no prompt embedding in it")
    own = {name for name in transformer.state_dict() if not name.startswith("base.")}
    load_exactly(transformer, tensors, own, path)
    return prompt.to(next(transformer.parameters()).dtype)


def load_exactly(module: nn.Module, tensors: dict[str, Tensor], names: set[str], path: Path) -> None:
    """Load tensors under exactly these names and shapes, or raise a one-line ``CheckpointError``.

    The module keeps its precision, whatever the file's.
    """
    state = module.state_dict()
    different = sorted(names ^ set(tensors))
    different += sorted(name for name in names & set(tensors) if state[name].shape != tensors[name].shape)
    if different:
        raise CheckpointError(
            f"{path}: does not fit this model; {len(different)} tensors differ, first {different[0]!r}"
        )
    cast = {name: value.to(state[name].dtype) for name, value in tensors.items()}
    with torch.no_grad():
        module.load_state_dict(cast, strict=False, assign=any(state[name].is_meta for name in names))
