"""The kernel of attention for training on processors."""

from __future__ import annotations

import contextlib
from contextlib import AbstractContextManager

import torch

from persist_backbones.diffusers_models import CogVideoXTransformer3DModel
from persist_backbones.tensors import frames_per_token
from persist_cli.api.cpu_attention import products_for_training


def kernel_for_training(model: CogVideoXTransformer3DModel, latents: torch.Tensor) -> AbstractContextManager[None]:
    """Within the block, attention on a processor is as ``products_for_training`` says.

    Blocks whose hidden states are computed again keep the fused kernel.

    Args:
        model: the transformer.
        latents: ``[batch, frame, channel, height, width]``, its input.
    """
    if model.gradient_checkpointing:
        return contextlib.nullcontext()
    config = model.config
    batch, frames, _, height, width = latents.shape
    tokens = config.max_text_seq_length + frames // frames_per_token(config) * height * width // config.patch_size**2
    return products_for_training(latents, batch * config.num_attention_heads * tokens**2)
