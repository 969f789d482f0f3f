"""Preparation of a backbone for sampling: precision, CPU offload, slices and tiles of its codec."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from persist_backbones.cogvideox.codec import pixel_patch
from persist_backbones.cogvideox.cogvideox import CogVideoX
from persist_backbones.cogvideox.model import WorldTransformer
from persist_backbones.diffusers_models import AutoencoderKLCogVideoX
from persist_cli.api.inference import InferenceOptions
from persist_cli.errors import CheckpointError

if TYPE_CHECKING:
    from persist_backbones.extensions.offload import OffloadedParts

OVERLAP = 1 / 6  # of a tile, diffusers' own


def bring_when_run(transformer: WorldTransformer) -> None:
    """Bring diffusers' transformer to the accelerator whenever the world transformer runs its blocks one by one.

    accelerate brings an offloaded module only when the module's own ``forward`` runs.
    """

    def bring(module: nn.Module, _: Any) -> None:
        hook = getattr(module.base, "_hf_hook", None)
        if hook is not None:
            hook.pre_forward(module.base)

    transformer.register_forward_pre_hook(bring)


def prepare_inference(
    backbone: CogVideoX, offloaded: OffloadedParts | None, options: InferenceOptions, device: torch.device
) -> OffloadedParts | None:
    """Get a backbone ready to sample.

    Args:
        backbone: the backbone, with the adapter in use, if any.
        offloaded: what the last call returned for this backbone, ``None`` at first.
        options: precision, offload, slices and tiles.
        device: the device that computes.

    Returns:
        The offloaded parts, which are on the CPU between clips, ``None`` without offload.
    """
    if offloaded is not None:
        offloaded.remove_all_hooks()  # weights that were on no device come back to the CPU
    vae, patch = backbone.codec.vae, pixel_patch(backbone.codec.vae)
    vae.disable_slicing()
    vae.disable_tiling()
    if options.slicing:
        vae.enable_slicing()
    if options.tiling:
        enable_tiling(vae, *(side // patch for side in backbone.image_size))
    if options.dtype is not None:
        backbone.to(getattr(torch, options.dtype))
    backbone.eval()
    if options.offload == "none":
        backbone.to(device)
        return None
    return offload(backbone, options, device)


def offload(backbone: CogVideoX, options: InferenceOptions, device: torch.device) -> OffloadedParts:
    """Keep the backbone's weights on the CPU; they come to the device when they are computed with."""
    from persist_backbones.extensions.offload import OffloadedModule, OffloadedParts  # all of diffusers' pipelines

    widening = {name: module for name, module in backbone.transformer.named_children() if name != "base"}
    world = OffloadedModule(widening)
    world.register_buffer("prompt", backbone.prompt)
    adapter = None if backbone.adapter is None else OffloadedModule({"adapter": backbone.adapter})
    parts = OffloadedParts(backbone.transformer.base, backbone.codec.vae, world, adapter)
    if options.offload == "model":
        parts.enable_model_cpu_offload(device=device)
    else:
        parts.enable_sequential_cpu_offload(device=device)
    backbone.prompt = world.get_buffer("prompt")
    return parts


def enable_tiling(vae: AutoencoderKLCogVideoX, height: int, width: int) -> None:
    """Let the VAE work in tiles of half the image's height and width, which overlap by whole latent pixels.

    With any other overlap, diffusers' tiles do not fit together to the image.

    Args:
        vae: diffusers' autoencoder.
        height: height of the VAE's input in its pixels.
        width: width of the VAE's input in its pixels.

    Raises:
        CheckpointError: when the image is too small to be tiled.
    """
    scale = 2 ** (len(vae.config.block_out_channels) - 1)
    tiles = [-(-side // (2 * scale)) for side in (height, width)]
    shares = [tile_overlap(tile, scale) for tile in tiles]
    vae.enable_tiling(tiles[0] * scale, tiles[1] * scale, *shares)


def tile_overlap(tile: int, scale: int) -> float:
    """Return the overlap, as a share of a tile, that gives whole pixels in diffusers' arithmetic, near its default.

    Args:
        tile: latent pixels along the edge of a tile.
        scale: pixels along the edge of a latent pixel.
    """
    for pixels in sorted(range(1, tile), key=lambda count: abs(count - OVERLAP * tile)):
        share = pixels / tile
        if int(tile * share) == pixels and int(tile * scale * (1 - share)) == scale * (tile - pixels):
            return share
    raise CheckpointError(f"vae-tiling: tiles of {tile} latent pixels are too small to overlap; leave it out")
