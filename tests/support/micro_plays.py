"""Walks with the keys in a micro model."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from persist_backbones.cogvideox.cogvideox import CogVideoX
from persist_cli.api.backbone import Sampling
from persist_cli.api.memory import FrameOfReference
from persist_cli.data.store import Store
from persist_cli.play.play import Play
from persist_cli.play.settings import PlaySettings
from persist_cli.play.walkers import AdaptedWorld
from persist_cli.plugins import make_encoder, make_memory
from persist_cli.rollout.world_model import Agent
from tests.support.micro_worlds import remembering_model


def micro_walks(walks: Path, kind: type[Play] = Play, backbone: CogVideoX | None = None) -> Callable[[], Play]:
    """What makes walks of a class that share a model, with a voxel memory and without one."""
    backbone, start = backbone or remembering_model(), Store(walks)[0].read([8])
    reference = FrameOfReference(start.info.scene, start.info.world_up)

    def walk() -> Play:
        memory = make_memory("voxel", {}, make_encoder("patches", {}), reference)
        worlds = {
            "voxel": AdaptedWorld(backbone, [Agent(memory)], Sampling(), "voxel"),
            "stage1": AdaptedWorld(backbone, [Agent(None)], Sampling(), None),
        }
        return kind(worlds, start, PlaySettings(ahead=False), "micro")

    return walk
