"""Reduced twins of the five published models: the same configuration keys, few layers, written by diffusers alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from diffusers import AutoencoderKLCogVideoX, CogVideoXDDIMScheduler, CogVideoXDPMScheduler, CogVideoXTransformer3DModel

from persist_backbones.cogvideox.cogvideox import CogVideoX
from persist_cli.plugins import make_backbone
from tests.support.published_configs import SCHEDULERS, TRANSFORMERS, VAES

NAMES = tuple(TRANSFORMERS)

SIZE = (17, 32, 48)  # frames, height and width in the configurations

SMALL = {
    "num_attention_heads": 2, "attention_head_dim": 16, "num_layers": 2, "time_embed_dim": 16, "text_embed_dim": 8,
    "max_text_seq_length": 10, "sample_height": 8, "sample_width": 12, "sample_frames": 17,
}  # fmt: skip

SMALL_VAE = {
    "block_out_channels": [8, 8, 8], "norm_num_groups": 4, "latent_channels": 4, "layers_per_block": 1,
    "down_block_types": ["CogVideoXDownBlock3D"] * 3, "up_block_types": ["CogVideoXUpBlock3D"] * 3,
}  # fmt: skip


def transformer_config(name: str) -> dict[str, Any]:
    """Return the published configuration with small sizes."""
    published = TRANSFORMERS[name]
    channels = {"in_channels": published["in_channels"] // 4, "out_channels": published["out_channels"] // 4}
    offset = {"ofs_embed_dim": 16} if "ofs_embed_dim" in published else {}
    return published | SMALL | channels | offset


def write_twin(name: str, folder: Path) -> Path:
    """Write a diffusers directory; its scheduler is DPM, except for 2b, and their files differ in the class alone."""
    torch.manual_seed(0)
    transformer = CogVideoXTransformer3DModel(**transformer_config(name))
    if transformer.config.use_learned_positional_embeddings:
        transformer.patch_embed.pos_embedding.normal_()
    transformer.save_pretrained(folder / "transformer")
    vae = AutoencoderKLCogVideoX(**(VAES[name] | SMALL_VAE))
    vae.encoder.conv_out.conv.bias.data[4:] = -60.0  # no noise: diffusers' pipeline draws the image latents, we do not
    vae.save_pretrained(folder / "vae")
    scheduler = CogVideoXDDIMScheduler if name == "2b" else CogVideoXDPMScheduler
    scheduler(**SCHEDULERS[name]).save_pretrained(folder / "scheduler")
    return folder


def write_snapshot(hub: Path, name: str) -> Path:
    """Make an entry for a repository in a hub's cache, and return the folder for the files of its only snapshot."""
    commit, home = "0" * 40, hub / f"models--{name.replace('/', '--')}"
    (home / "refs").mkdir(parents=True)
    (home / "refs" / "main").write_text(commit)
    return home / "snapshots" / commit


def load_twin(folder: Path, size: tuple[int, int, int] = SIZE, **settings: Any) -> CogVideoX:
    """Load a twin as our backbone, by default without a prompt, since a twin has no text encoder."""
    frames, height, width = size
    chosen = {"frames": frames, "height": height, "width": width, "prompt": None}
    backbone = make_backbone("cogvideox", {"pretrained": str(folder)} | chosen | settings)
    assert isinstance(backbone, CogVideoX)
    return backbone.eval()
