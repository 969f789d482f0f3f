"""Positions that CogVideoX adds to its tokens from a table, at the size of the clips."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from diffusers import CogVideoXTransformer3DModel
from jaxtyping import Float
from torch import Tensor

from persist_backbones.rotary import middle_region
from persist_cli.world.errors import CheckpointError


def fit_positions(transformer: CogVideoXTransformer3DModel, size: tuple[int, int, int]) -> None:
    """Make the table of a transformer one for clips of this size, where it has a table of another.

    diffusers computes a sinusoidal table again at every call; here it is computed once. It refuses a learned table
    for images of another size (CogVideoX-5b-I2V) and leaves it out for clips of another length: here its first frames
    are taken, and of each the middle of the images' shape, resampled. The configuration then has the new size.

    Args:
        transformer: diffusers'.
        size: frames, rows and columns of the latents.

    Raises:
        CheckpointError: for clips longer than a learned table.
    """
    table = transformer.patch_embed
    shown = dict(zip(("sample_frames", "sample_height", "sample_width"), size, strict=True))
    shown["sample_frames"] = (size[0] - 1) * table.temporal_compression_ratio + 1
    if all(getattr(table, name) == value for name, value in shown.items()):
        return
    if table.use_learned_positional_embeddings:
        table.pos_embedding = _resampled(transformer, size)
        transformer.register_to_config(**shown)
    elif table.use_positional_embeddings:
        rows, columns, frames = size[1], size[2], shown["sample_frames"]
        device = table.pos_embedding.device
        table.pos_embedding = table._get_positional_embeddings(rows, columns, frames, device=device)
    else:
        return
    for name, value in shown.items():
        setattr(table, name, value)


def _resampled(
    transformer: CogVideoXTransformer3DModel, size: tuple[int, int, int]
) -> Float[Tensor, "1 word+token channel"]:
    """The learned table for latents of this size."""
    table, patch = transformer.patch_embed, transformer.config.patch_size
    words, frames, rows, columns = table.max_text_seq_length, size[0], size[1] // patch, size[2] // patch
    trained = (table.sample_height // patch, table.sample_width // patch)
    video = table.pos_embedding[0, words:].unflatten(0, (-1, *trained))
    if frames > len(video):
        longest = (len(video) - 1) * table.temporal_compression_ratio + 1
        raise CheckpointError(f"learned positions are for clips of {longest} frames at most; ask for fewer frames")
    (top, left), (bottom, right) = middle_region((rows, columns), trained)
    middle = video[:frames, top:bottom, left:right].permute(0, 3, 1, 2)
    if middle.shape[2:] != (rows, columns):
        middle = F.interpolate(middle.float(), (rows, columns), mode="bilinear").to(video.dtype)
    return torch.cat([table.pos_embedding[:, :words], middle.permute(0, 2, 3, 1).flatten(0, 2)[None]], dim=1)
