"""A checkpoint as a pipeline, without the tool."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import torch

from persist_backbones.cogvideox.config import CogVideoXSettings
from persist_backbones.extensions.backbone import ExtendedCogVideoX
from persist_backbones.pipeline.pipeline import WorldPipeline
from persist_cli.api.inference import Precision
from persist_cli.errors import CheckpointError, hint
from persist_cli.io.checkpoint_folder import CARD, PLAIN, adapter_folder, default_adapter, open_checkpoint
from persist_cli.io.settings import parse_settings

NAME = "cogvideox"


def load_pipeline(folder: Path, adapter: str | None, dtype: Precision | None) -> WorldPipeline:
    """See ``persist_backbones.load``."""
    if dtype is not None and dtype not in get_args(Precision):
        raise CheckpointError(f"unknown dtype {dtype!r}; {hint(dtype, get_args(Precision))}")
    found = open_checkpoint(folder)
    card = found.base_card
    if card["backbone"] != NAME:
        raise CheckpointError(f"{found.base / CARD}: a checkpoint of backbone {card['backbone']!r}, not of {NAME!r}")
    with torch.device("meta"):  # weights come from the files
        backbone = ExtendedCogVideoX(parse_settings(CogVideoXSettings, card["settings"], str(found.base / CARD)))
    backbone.name = NAME
    backbone.load_base(found.base)
    chosen = adapter or default_adapter(found.folder, found.adapters, found.card.get("default_adapter"))
    if chosen is not None and chosen != PLAIN:
        backbone.load_adapter(chosen, adapter_folder(found.folder, found.adapters, chosen))
    return WorldPipeline.of(backbone.to(getattr(torch, dtype or "float32")).eval())
