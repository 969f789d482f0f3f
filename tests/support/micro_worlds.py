"""A micro model with a memory adapter, and world models that stand at a frame of a walk and remember those before."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from persist_backbones.cogvideox.cogvideox import CogVideoX
from persist_cli.api.backbone import Sampling
from persist_cli.api.memory import FrameOfReference
from persist_cli.data.store import Store
from persist_cli.plugins import make_encoder, make_memory
from persist_cli.rollout.world_model import Agent, WorldModel
from tests.support.micro_model import micro, shaken


def remembering_model(adapter: Mapping[str, Any] = MappingProxyType({}), **settings: Any) -> CogVideoX:
    """Make a micro model with an adapter for patches, all of whose parts have an effect."""
    backbone = micro(**settings)
    backbone.add_adapter("voxel", make_encoder("patches", {}).channels, {"width": 16, "heads": 2} | dict(adapter))
    shaken(backbone)
    return backbone


def world_on_walk(backbone: CogVideoX, walks: Path, kind: str = "voxel", **agent: Any) -> WorldModel:
    """Make a world model at the ninth frame of the first walk, with a memory of the eight frames before it."""
    walk = Store(walks)[0].read()
    memory = make_memory(kind, {}, make_encoder("patches", {}), FrameOfReference("room-0", walk.info.world_up))
    memory.write(walk.observations[:8])
    model = WorldModel(backbone, [Agent(memory, **agent)], Sampling(2))
    model.reset([walk.observations[8:9]], [walk.info])
    return model
