"""The kernel of attention for training on processors."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch
from torch.nn.attention import SDPBackend, sdpa_kernel

from persist_backbones.diffusers_models import CogVideoXTransformer3DModel
from persist_backbones.tensors import frames_per_token

MOST_WEIGHTS = 1 << 27  # of one layer's attention that are kept for the backward pass


@contextlib.contextmanager
def kernel_for_training(model: CogVideoXTransformer3DModel, latents: torch.Tensor) -> Iterator[None]:
    """Within the block, attention in bfloat16 on a processor is made of matrix products where gradients are wanted.

    The backward pass of PyTorch's fused kernel is slow there (``python tests/benchmarks/bench_attention.py``).
    Matrix products keep all weights of attention until then, so longer clips have the fused kernel, and so have blocks
    whose hidden states are computed again, and all other devices.

    Args:
        model: the transformer.
        latents: ``[batch, frame, channel, height, width]``, its input.
    """
    config = model.config
    batch, frames, _, height, width = latents.shape
    tokens = config.max_text_seq_length + frames // frames_per_token(config) * height * width // config.patch_size**2
    fits = batch * config.num_attention_heads * tokens**2 <= MOST_WEIGHTS
    wanted = torch.is_grad_enabled() and not model.gradient_checkpointing
    precision = torch.get_autocast_dtype("cpu") if torch.is_autocast_enabled("cpu") else latents.dtype
    if latents.device.type != "cpu" or precision != torch.bfloat16 or not fits or not wanted:
        yield
        return
    before = torch.backends.cuda.fp16_bf16_reduction_math_sdp_allowed()
    torch.backends.cuda.allow_fp16_bf16_reduction_math_sdp(True)  # else products of bfloat16 are made in float32
    try:
        with sdpa_kernel(SDPBackend.MATH):
            yield
    finally:
        torch.backends.cuda.allow_fp16_bf16_reduction_math_sdp(before)
