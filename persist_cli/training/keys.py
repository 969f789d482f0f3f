"""Keys of cached latents and memory tokens: what they depend on."""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

import torch

from persist_cli import __version__
from persist_cli.memorizing.recall import MemoryMaker
from persist_cli.recipe import MemoryChoice, Recipe
from persist_cli.registry import find_plugin
from persist_cli.training.cache import cache_key
from persist_cli.trajectories.clips import ClipChoice
from persist_cli.world.backbone import Backbone
from persist_cli.world.files import file_sha256


@dataclasses.dataclass(frozen=True)
class ClipKeys:
    """The keys of one clip.

    Args:
        latents: of its latents, or of those of its whole trajectory.
        tokens: of its memory tokens, ``None`` without a memory.
    """

    latents: str
    tokens: str | None


@dataclasses.dataclass(frozen=True)
class CacheKeys:
    """The keys of all clips of a run.

    Args:
        latents: what latents depend on besides the clip, JSON values.
        tokens: what memory tokens depend on besides the clip, ``None`` without a memory.
        whole: whether latents are those of whole trajectories.
    """

    latents: dict[str, Any]
    tokens: dict[str, Any] | None
    whole: bool
    hashes: dict[Path, str] = dataclasses.field(default_factory=dict)  # of trajectories, each computed once

    @staticmethod
    def of(recipe: Recipe, backbone: Backbone, maker: MemoryMaker | None, device: str) -> CacheKeys:
        """Those of a run.

        Args:
            recipe: of the run.
            backbone: which encodes, and on which the budget of tokens and the size of images depend.
            maker: of memories, ``None`` without one.
            device: the kind of device that encodes.
        """
        made_by = {"persist": __version__, "torch": torch.__version__, "device": device}
        latents = made_by | {"encoding": backbone.encoding(), "precision": recipe.training.precision}
        tokens = None
        if maker is not None and recipe.memory is not None:
            tokens = made_by | _of_memory(recipe.memory, maker, backbone)
        return CacheKeys(latents, tokens, backbone.frames_alone)

    def of_clip(self, choice: ClipChoice) -> ClipKeys:
        """The keys of a clip."""
        clip = {"trajectory": self._trajectory(choice.file.path), "frames": list(choice.frames)}
        latents = cache_key((clip | {"frames": "all"} if self.whole else clip) | self.latents)
        if self.tokens is None:
            return ClipKeys(latents, None)
        return ClipKeys(latents, cache_key(clip | {"context": list(choice.context)} | self.tokens))

    def _trajectory(self, path: Path) -> str:
        if path not in self.hashes:
            self.hashes[path] = file_sha256(path)
        return self.hashes[path]


def _of_memory(choice: MemoryChoice, maker: MemoryMaker, backbone: Backbone) -> dict[str, Any]:
    """What tokens depend on; an encoder's weights are told by the features that they give of a fixed picture."""
    height, width = backbone.image_size
    picture = torch.arange(height * width * 3).reshape(1, height, width, 3) * 37 % 256
    features = maker.encoder.encode(picture.to(torch.uint8)).float().cpu().contiguous().numpy().data
    plugins = [find_plugin("memory", choice.name), find_plugin("encoder", choice.encoder)]
    return {
        "memory": choice.name,
        "settings": dataclasses.asdict(maker.settings),
        "encoder": choice.encoder,
        "encoder_settings": dataclasses.asdict(maker.encoder.settings),
        "features": hashlib.sha256(features).hexdigest(),
        "budget": backbone.token_budget,
        "packages": [[plugin.package, plugin.version] for plugin in plugins],
    }
