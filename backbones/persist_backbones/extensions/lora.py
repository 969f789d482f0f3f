"""LoRA on diffusers' transformer: PEFT's layers in training, and a file that diffusers' pipelines load."""

from __future__ import annotations

import json
from pathlib import Path

import torch

from persist_backbones.cogvideox.parameter_groups import LORA
from persist_backbones.cogvideox.parts import PREFIX, weights_digest
from persist_backbones.diffusers_models import (
    LORA_ADAPTER_METADATA_KEY,
    LORA_WEIGHT_NAME_SAFE,
    CogVideoXTransformer3DModel,
)
from persist_cli.api.stages import Lora
from persist_cli.errors import PersistError, RecipeError, hint
from persist_cli.io.files import write_tensors


def add_lora(transformer: CogVideoXTransformer3DModel, lora: Lora) -> None:
    """Put PEFT's layers around the targets; before training the output stays equal to the bit.

    Raises:
        PersistError: when PEFT is not installed, or a target is not a linear layer of the transformer.
    """
    try:
        from peft import LoraConfig
    except ImportError as error:
        raise PersistError("lora needs the package peft: pip install 'persist-cli[lora]'") from error
    linear = {name for name, module in transformer.named_modules() if isinstance(module, torch.nn.Linear)}
    for target in lora.targets:
        if not any(name == target or name.endswith(f".{target}") for name in linear):
            known = sorted({name.split(".", 2)[-1] for name in linear if name.startswith("transformer_blocks.")})
            raise RecipeError(f"lora.targets: no linear layer {target!r} in the transformer; {hint(target, known)}")
    alpha = lora.rank if lora.alpha is None else lora.alpha
    transformer.weights_before_lora = weights_digest(transformer) if transformer.device.type != "meta" else ""
    transformer.add_adapter(LoraConfig(r=lora.rank, lora_alpha=alpha, target_modules=list(lora.targets)))


def has_lora(transformer: CogVideoXTransformer3DModel) -> bool:
    """Whether the transformer has layers of LoRA, which are trained in place of its weights."""
    return bool(getattr(transformer, "peft_config", None))


def train_lora(transformer: CogVideoXTransformer3DModel) -> None:
    """Freeze all weights but those of LoRA, if the transformer has LoRA."""
    if has_lora(transformer):
        for name, parameter in transformer.named_parameters():
            parameter.requires_grad_(LORA in name)


def save_lora(transformer: CogVideoXTransformer3DModel, folder: Path) -> None:
    """Write ``pytorch_lora_weights.safetensors``, which diffusers' pipelines load by ``load_lora_weights(folder)``."""
    from peft import get_peft_model_state_dict

    config = transformer.peft_config["default"].to_dict()
    plain = {PREFIX + key: sorted(value) if isinstance(value, set) else value for key, value in config.items()}
    tensors = {PREFIX + name: tensor for name, tensor in get_peft_model_state_dict(transformer).items()}
    metadata = {"format": "pt", LORA_ADAPTER_METADATA_KEY: json.dumps(plain, sort_keys=True)}
    write_tensors(folder / LORA_WEIGHT_NAME_SAFE, tensors, metadata | {"digest": transformer.weights_before_lora})
