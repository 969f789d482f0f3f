"""A checkpoint folder's files: diffusers' parts, what is ours beside them, and LoRA merged into its base."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import torch
from diffusers import CogVideoXTransformer3DModel
from diffusers.loaders.lora_base import LORA_ADAPTER_METADATA_KEY, LORA_WEIGHT_NAME_SAFE
from torch import Tensor

from persist_backbones.cogvideox.model import WorldTransformer
from persist_backbones.cogvideox.pretrained import DiffusersParts
from persist_cli.errors import CheckpointError
from persist_cli.io.files import load_exactly, read_tensors, write_tensors

PREFIX = "transformer."  # of the names in a pipeline's LoRA file
DOWN, UP = ".lora_A.weight", ".lora_B.weight"
SAMPLED = 256  # values of a tensor that its digest looks at


def save_parts(parts: DiffusersParts, folder: Path) -> None:
    """Write diffusers' parts, each loadable by diffusers alone."""
    parts.transformer.save_pretrained(folder / "transformer")
    parts.vae.save_pretrained(folder / "vae")
    parts.scheduler.save_pretrained(folder / "scheduler")


def save_world(transformer: WorldTransformer, prompt: Tensor, folder: Path) -> None:
    """Write ``world.safetensors``: widening, interactions and the prompt's embedding."""
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
    for name in sorted(name for name in tensors if name.endswith(DOWN)):
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
