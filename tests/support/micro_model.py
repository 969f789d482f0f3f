"""A micro CogVideoX, and random clips and tokens for it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from persist_backbones.adapters.base import MemoryCondition
from persist_backbones.adapters.forms import FORMS
from persist_backbones.cogvideox.cogvideox import CogVideoX
from persist_cli.api.backbone import Clips
from persist_cli.api.cameras import Cameras
from persist_cli.api.tokens import MemoryTokens
from persist_cli.plugins import make_backbone
from tests.support.micro_runs import MICRO, SIZE

CHANNELS = 6

FRAMEWISE = {"vae": MICRO["vae"] | {"temporal_compression_ratio": 1}}  # settings of a codec that codes frames alone

POINT_FORMS = [name for name, form in FORMS.items() if not form.reads_frames]  # of tokens that are points


def micro(**settings: Any) -> CogVideoX:
    """Make a micro model with weights of seed 0."""
    torch.manual_seed(0)
    backbone = make_backbone("cogvideox", MICRO | settings)
    assert isinstance(backbone, CogVideoX)
    return backbone.eval()


def with_adapter(backbone: CogVideoX, **settings: Any) -> CogVideoX:
    """Add a fresh adapter to the model and use it."""
    torch.manual_seed(1)
    backbone.add_adapter("voxel", CHANNELS, {"width": 16, "dropout": 0.0} | settings)
    return backbone


def shaken(module: torch.nn.Module, scale: float = 0.1) -> None:
    """Change every weight, as training would."""
    draw = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.add_(torch.randn(parameter.shape, generator=draw) * scale)


def trained(form: str = "cross", **settings: Any) -> CogVideoX:
    """Make a micro model with an adapter, both with weights as if trained."""
    backbone = with_adapter(micro(**settings), form=form, **({"head_width": 8} if form == "canvas" else {}))
    shaken(backbone)
    return backbone


def equal(one: Sequence[Tensor], two: Sequence[Tensor]) -> bool:
    """Whether two sequences of tensors are equal to the bit."""
    return all(torch.equal(a, b) for a, b in zip(one, two, strict=True))


def random_tokens(batch: int, count: int, seed: int = 3) -> MemoryTokens:
    """Make tokens with random features, within a few metres of the origin."""
    draw = torch.Generator().manual_seed(seed)
    features = torch.randn(batch, count, CHANNELS, generator=draw)
    positions = torch.randn(batch, count, 3, generator=draw, dtype=torch.float64) * 2
    colors = torch.randint(0, 256, (batch, count, 3), generator=draw, dtype=torch.uint8)
    return MemoryTokens(features, positions, torch.ones(batch, count, dtype=torch.bool), colors)


def random_clips(
    batch: int = 2,
    tokens: MemoryTokens | None = None,
    interactions: Any = None,
    size: tuple[int, int, int] = (9, SIZE, SIZE),
) -> Clips:
    """Make clips of noise, of ``size`` frames, height and width, on a path that moves ahead."""
    draw = torch.Generator().manual_seed(2)
    frames, height, width = size
    poses = torch.eye(4, dtype=torch.float64).repeat(batch, frames, 1, 1)
    poses[:, :, 2, 3] = torch.arange(frames) * 0.25
    focal = width * 0.7
    matrix = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
    return Clips(
        rgb=torch.randint(0, 256, (batch, *size, 3), generator=draw, dtype=torch.uint8),
        depth=torch.rand(batch, *size, generator=draw) * 4 + 0.3,
        cameras=Cameras(poses, matrix.expand(batch, frames, 3, 3), height, width),
        interactions=interactions or [(None,) * (frames - 1)] * batch,
        tokens=tokens,
        seeds=list(range(batch)),
    )


def predicted(backbone: CogVideoX, clips: Clips, tokens: MemoryTokens | None) -> Tensor:
    """Predict from the clips' latents and tokens at one noise level."""
    return predicted_of(backbone, clips, backbone.memory_condition(dataclasses.replace(clips, tokens=tokens)))


@torch.no_grad()
def predicted_of(backbone: CogVideoX, clips: Clips, memory: MemoryCondition) -> Tensor:
    """Predict from the clips' latents and a prepared memory at one noise level."""
    latents = backbone.codec.encode(clips.rgb, clips.depth)
    conditions = backbone.conditions(clips, torch.full((len(clips.seeds),), 500), memory)
    return backbone.predict(latents, backbone.encode_first(clips), conditions)
