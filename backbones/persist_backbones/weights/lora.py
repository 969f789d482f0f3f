"""LoRA on diffusers' transformer: PEFT's layers while it trains, a file that diffusers' pipelines load, and merging."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import torch
from diffusers import CogVideoXTransformer3DModel
from diffusers.loaders.lora_base import LORA_ADAPTER_METADATA_KEY, LORA_WEIGHT_NAME_SAFE

from persist_backbones.inventory import LORA
from persist_cli.world.errors import CheckpointError, PersistError, RecipeError, hint
from persist_cli.world.files import read_tensors, write_tensors
from persist_cli.world.stages import Lora

PREFIX = "transformer."  # of the names in a pipeline's LoRA file
DOWN, UP = ".lora_A.weight", ".lora_B.weight"
SAMPLED = 256  # values of a tensor that its digest looks at


def add_lora(transformer: CogVideoXTransformer3DModel, lora: Lora) -> None:
    """Put PEFT's layers around the targets; the first output is that without them, to the bit.

    Raises:
        PersistError: when PEFT is not installed, or a target is no linear layer of the transformer.
    """
    try:
        from peft import LoraConfig
    except ImportError as error:
        raise PersistError("lora needs the package peft: pip install 'persist-cli[lora]'") from error
    linear = {name for name, each in transformer.named_modules() if isinstance(each, torch.nn.Linear)}
    for target in lora.targets:
        if not any(name == target or name.endswith(f".{target}") for name in linear):
            known = sorted({name.split(".", 2)[-1] for name in linear if name.startswith("transformer_blocks.")})
            raise RecipeError(f"lora.targets: no linear layer {target!r} in the transformer; {hint(target, known)}")
    alpha = lora.rank if lora.alpha is None else lora.alpha
    transformer.weights_before_lora = weights_digest(transformer) if transformer.device.type != "meta" else ""
    transformer.add_adapter(LoraConfig(r=lora.rank, lora_alpha=alpha, target_modules=list(lora.targets)))


def has_lora(transformer: CogVideoXTransformer3DModel) -> bool:
    """Whether it has layers of LoRA, which train instead of it."""
    return bool(getattr(transformer, "peft_config", None))


def train_lora(transformer: CogVideoXTransformer3DModel) -> None:
    """Where there is LoRA, freeze all else."""
    if has_lora(transformer):
        for name, parameter in transformer.named_parameters():
            parameter.requires_grad_(LORA in name)


def save_lora(transformer: CogVideoXTransformer3DModel, folder: Path) -> None:
    """Write ``pytorch_lora_weights.safetensors``, as diffusers' pipelines load it by ``load_lora_weights(folder)``."""
    from peft import get_peft_model_state_dict

    config = transformer.peft_config["default"].to_dict()
    plain = {PREFIX + key: sorted(each) if isinstance(each, set) else each for key, each in config.items()}
    tensors = {PREFIX + name: tensor for name, tensor in get_peft_model_state_dict(transformer).items()}
    metadata = {"format": "pt", LORA_ADAPTER_METADATA_KEY: json.dumps(plain, sort_keys=True)}
    write_tensors(folder / LORA_WEIGHT_NAME_SAFE, tensors, metadata | {"digest": transformer.weights_before_lora})


@torch.no_grad()
def merge_lora(transformer: CogVideoXTransformer3DModel, folder: Path, check: bool) -> None:
    """Add what ``save_lora`` wrote to the weights that it was trained on.

    Args:
        transformer: with those weights.
        folder: that was written into.
        check: whether these are those weights.

    Raises:
        CheckpointError: when the file is missing or corrupt, or these are other weights.
    """
    path = folder / LORA_WEIGHT_NAME_SAFE
    tensors, metadata = read_tensors(path)
    scale = _scale(metadata, path)
    if check and metadata.get("digest") != weights_digest(transformer):
        raise CheckpointError(f"{path}: was trained on other weights than those that it is to change")
    weights = dict(transformer.named_parameters())
    for name in sorted(each for each in tensors if each.endswith(DOWN)):
        module = name.removeprefix(PREFIX).removesuffix(DOWN)
        down, up = tensors[name], tensors.get(name.removesuffix(DOWN) + UP)
        weight = weights.get(f"{module}.weight")
        if up is None or weight is None or weight.shape != (up.shape[0], down.shape[1]):
            raise CheckpointError(f"{path}: does not fit this model at {module!r}")
        weight.add_((scale * up.double() @ down.double()).to(weight))


def weights_digest(transformer: CogVideoXTransformer3DModel) -> str:
    """A hash of names, shapes and some values of each weight: tells models apart without reading all of them."""
    digest = hashlib.sha256()
    for name, tensor in sorted(transformer.state_dict().items()):  # tables of positions too
        values = tensor.detach().flatten()
        some = values[:: max(1, len(values) // SAMPLED)].float().cpu().contiguous()
        digest.update(f"{name} {tuple(tensor.shape)}".encode() + some.numpy().tobytes())
    return digest.hexdigest()


def _scale(metadata: dict[str, str], path: Path) -> float:
    try:
        config: dict[str, Any] = json.loads(metadata[LORA_ADAPTER_METADATA_KEY])
        return float(config[f"{PREFIX}lora_alpha"]) / int(config[f"{PREFIX}r"])
    except (KeyError, ValueError, TypeError) as error:
        raise CheckpointError(f"{path}: it does not say its rank and alpha") from error
