"""Where a backbone samples: precision, CPU offload, slices and tiles of its codec."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from diffusers import AutoencoderKLCogVideoX, CogVideoXTransformer3DModel, DiffusionPipeline
from diffusers.models.modeling_utils import ModelMixin
from torch import nn

from persist_backbones.cogvideox.codec import pixel_patch
from persist_backbones.cogvideox.cogvideox import CogVideoX
from persist_backbones.cogvideox.model import WorldTransformer
from persist_cli.api.inference import InferenceOptions
from persist_cli.errors import CheckpointError

OVERLAP = 1 / 6  # of a tile, diffusers' own


class OffloadingPipeline(DiffusionPipeline):  # type: ignore[misc]
    """diffusers' CPU offload for a world model: what stands between the transformer's blocks goes with them."""

    model_cpu_offload_seq = "transformer->vae"

    def enable_sequential_cpu_offload(self, gpu_id: int | None = None, device: Any = None) -> None:
        """As diffusers' own: every layer of every component is on the accelerator while it runs."""
        self._exclude_from_cpu_offload: list[str] = []
        super().enable_sequential_cpu_offload(gpu_id, device)

    def enable_model_cpu_offload(self, gpu_id: int | None = None, device: Any = None) -> None:
        """As diffusers' own; what runs between the transformer's blocks stays on the accelerator."""
        self._exclude_from_cpu_offload = ["world", "adapter"]
        super().enable_model_cpu_offload(gpu_id, device)


class OffloadedModule(ModelMixin):  # type: ignore[misc]
    """Modules of ours, shared, with what diffusers' offload wants to know of a model.

    Args:
        modules: by name.
    """

    def __init__(self, modules: Mapping[str, nn.Module]) -> None:
        super().__init__()
        for name, module in modules.items():
            self.add_module(name, module)


class OffloadedParts(OffloadingPipeline):
    """The parts of a backbone that is offloaded; it samples by itself.

    Args:
        transformer: diffusers' own.
        vae: diffusers' own.
        world: what makes the transformer a world model, with the prompt's embedding.
        adapter: of memory, if one is in use.
    """

    _optional_components: ClassVar = ["adapter"]

    def __init__(
        self,
        transformer: CogVideoXTransformer3DModel,
        vae: AutoencoderKLCogVideoX,
        world: OffloadedModule,
        adapter: OffloadedModule | None,
    ) -> None:
        super().__init__()
        self.register_modules(transformer=transformer, vae=vae, world=world, adapter=adapter)


def bring_when_run(transformer: WorldTransformer) -> None:
    """Let diffusers' transformer come to the accelerator whenever ours runs, whose blocks are run one by one.

    accelerate brings an offloaded module only when its own ``forward`` runs.
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
        backbone: with the adapter to use, if any.
        offloaded: what this gave for the backbone before, if it did.
        options: precision, offload, slices and tiles.
        device: where it computes.

    Returns:
        The parts that rest on the CPU between clips, if any do.
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
    widening = {name: module for name, module in backbone.transformer.named_children() if name != "base"}
    world = OffloadedModule(widening)
    world.register_buffer("prompt", backbone.prompt)
    adapter = None if backbone.adapter is None else OffloadedModule({"adapter": backbone.adapter})
    parts = OffloadedParts(backbone.transformer.base, vae, world, adapter)
    if options.offload == "model":
        parts.enable_model_cpu_offload(device=device)
    else:
        parts.enable_sequential_cpu_offload(device=device)
    backbone.prompt = world.get_buffer("prompt")
    return parts


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
    shares = [tile_overlap(tile, scale) for tile in tiles]
    vae.enable_tiling(tiles[0] * scale, tiles[1] * scale, *shares)


def tile_overlap(tile: int, scale: int) -> float:
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
