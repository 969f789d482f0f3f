"""Where a CogVideoX backbone samples: precision, CPU offload, slices and tiles of its codec."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from persist_backbones.codec import pixel_patch
from persist_backbones.pipelines.pipeline import WorldPipeline
from persist_backbones.sampling.tiling import enable_tiling
from persist_cli.world.placement import Placement

if TYPE_CHECKING:
    from persist_backbones.cogvideox import CogVideoX


def place(backbone: CogVideoX, placement: Placement, device: torch.device) -> WorldPipeline | None:
    """Place a backbone for sampling; what keeps its weights on the CPU, and lets go of them after each clip, if any.

    The offloading is that of diffusers' pipelines, with accelerate's hooks.

    Args:
        backbone: with the adapter to use, if any; may be placed already.
        placement: what is asked for.
        device: where it computes.
    """
    if backbone.offloaded is not None:
        backbone.offloaded.remove_all_hooks()  # weights that were on no device come back to the CPU
    pipeline = WorldPipeline.of(backbone)
    vae, patch = backbone.codec.vae, pixel_patch(backbone.codec.vae)
    vae.disable_slicing()
    vae.disable_tiling()
    if placement.slicing:
        vae.enable_slicing()
    if placement.tiling:
        enable_tiling(vae, *(side // patch for side in backbone.image_size))
    if placement.dtype is not None:
        backbone.to(getattr(torch, placement.dtype))
    backbone.eval()
    if placement.offload == "none":
        backbone.to(device)
        return None
    pipeline.world.prompt = backbone.prompt
    if placement.offload == "model":
        pipeline.enable_model_cpu_offload(device=device)
    else:
        pipeline.enable_sequential_cpu_offload(device=device)
    backbone.prompt = pipeline.world.prompt
    return pipeline
