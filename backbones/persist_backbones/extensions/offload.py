"""Where a backbone samples: precision, CPU offload, slices and tiles of its codec."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from diffusers import AutoencoderKLCogVideoX
from torch import nn

from persist_backbones.cogvideox.codec import pixel_patch
from persist_backbones.pipeline.pipeline import WorldPipeline
from persist_cli.api.inference import InferenceOptions
from persist_cli.errors import CheckpointError

if TYPE_CHECKING:
    from persist_backbones.cogvideox.backbone import CogVideoX


def computing_device(module: nn.Module) -> torch.device:
    """Where a module computes: the device of the first offload hook in it that names one, else of its weights."""
    for part in module.modules():
        device = getattr(_hook(part), "execution_device", None)
        if device is not None:
            return torch.device(device)
    return next(module.parameters()).device


def bring(module: nn.Module) -> None:
    """Move a module that is offloaded as a whole to where it computes.

    accelerate does so when ``forward`` runs; this is for modules whose parts are run one by one.
    """
    hook = _hook(module)
    if hook is not None:
        hook.pre_forward(module)


def _hook(module: nn.Module) -> Any:
    return getattr(module, "_hf_hook", None)


OVERLAP = 1 / 6  # of a tile, diffusers' own


def enable_tiling(vae: AutoencoderKLCogVideoX, height: int, width: int) -> None:
    """Code in tiles of half the image's height and width, which overlap by a whole number of latent pixels.

    With an overlap that is not, diffusers' tiles do not make up the image.

    Args:
        vae: diffusers' autoencoder.
        height: of what it is given.
        width: likewise.

    Raises:
        CheckpointError: when the image is too small to be tiled.
    """
    scale = 2 ** (len(vae.config.block_out_channels) - 1)
    tiles = [-(-side // (2 * scale)) for side in (height, width)]
    shares = [overlap(tile, scale) for tile in tiles]
    vae.enable_tiling(tiles[0] * scale, tiles[1] * scale, *shares)


def overlap(tile: int, scale: int) -> float:
    """The share of a tile of latent pixels that diffusers' arithmetic makes whole pixels, nearest to its own.

    Args:
        tile: latent pixels along an edge.
        scale: pixels of a latent pixel.
    """
    for pixels in sorted(range(1, tile), key=lambda count: abs(count - OVERLAP * tile)):
        share = pixels / tile
        if int(tile * share) == pixels and int(tile * scale * (1 - share)) == scale * (tile - pixels):
            return share
    raise CheckpointError(f"vae-tiling: tiles of {tile} latent pixels are too small to overlap; leave it out")


def place(backbone: CogVideoX, placement: InferenceOptions, device: torch.device) -> WorldPipeline | None:
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
