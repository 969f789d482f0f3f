"""Clips that come again: what was made of one of them once is taken from the cache, what is missing is made and kept.

Everything is made of one clip alone, never of a batch, so that it does not depend on which clips stand beside it: a
step of cached clips equals one of clips that are encoded on the spot. Where a codec codes every frame alone, latents
are kept of whole trajectories instead and serve every clip that can be cut from them, at any stride; such a step equals
one without a cache up to the rounding of larger batches.
"""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator
from torch import Tensor
from torch.utils.data import Dataset

from persist_cli import __version__
from persist_cli.memorizing.recall import MemoryMaker, collate, recall
from persist_cli.recipe import Recipe
from persist_cli.training.cache import Cache, name_of
from persist_cli.trajectories.clips import ClipChoice, ClipDataset, ClipSample
from persist_cli.world.backbone import Backbone
from persist_cli.world.files import file_sha256
from persist_cli.world.observations import Observations
from persist_cli.world.tokens import MemoryTokens


@dataclasses.dataclass(frozen=True)
class Dependencies:
    """What latents and tokens depend on besides their clip, JSON values.

    Args:
        latents: of the backbone and the training.
        tokens: of the memory, ``None`` without one.
    """

    latents: dict[str, Any]
    tokens: dict[str, Any] | None

    @staticmethod
    def of(recipe: Recipe, backbone: Backbone, maker: MemoryMaker | None, device: torch.device) -> Dependencies:
        """Those of a run; encoder weights are told by the features that they give of a fixed picture."""
        made_by = {"persist": __version__, "torch": torch.__version__, "device": device.type}
        latents = made_by | {"encoding": backbone.encoding(recipe.stage), "precision": recipe.training.precision}
        if maker is None or recipe.memory is None:
            return Dependencies(latents, None)
        height, width = backbone.image_size
        picture = torch.arange(height * width * 3).reshape(1, height, width, 3) * 37 % 256
        features = maker.encoder.encode(picture.to(torch.uint8)).float().cpu().contiguous().numpy().data
        memory = {
            "memory": recipe.memory.name,
            "settings": dataclasses.asdict(maker.settings),
            "encoder": recipe.memory.encoder,
            "encoder_settings": dataclasses.asdict(maker.encoder.settings),
            "features": hashlib.sha256(features).hexdigest(),
            "budget": backbone.token_budget,
        }
        return Dependencies(latents, made_by | memory)


def rows_of(latents: Tensor, choice: ClipChoice, whole: bool) -> Tensor:
    """The clip's latents, its first frame's repeated at the end, of those of its ``whole`` trajectory or its own."""
    return latents[[*choice.frames, choice.frames[0]]] if whole else latents


class KeptClips(Dataset[ClipSample]):
    """Clips with the latents and tokens that a cache has of them; of those, no image is read.

    Args:
        clips: the clips.
        cache: where latents and tokens are.
        given: what they depend on besides the clip.
        whole: whether latents are those of whole trajectories.
    """

    def __init__(self, clips: ClipDataset, cache: Cache, given: Dependencies, whole: bool = False) -> None:
        self.clips, self.cache, self.given, self.whole = clips, cache, given, whole
        self.hashes: dict[Path, str] = {}

    def __getitem__(self, number: int) -> ClipSample:
        choice = self.clips.choose(number)
        keys = self.keys(choice)
        latents = self.cache.get(keys[0])
        tokens = self.cache.get(keys[1]) if choice.context else None
        sample = self.clips.read(choice, images=latents is None, context=tokens is None)
        return replace(
            sample,
            latents=None if latents is None else rows_of(latents["latents"], choice, self.whole),
            tokens=None if tokens is None else MemoryTokens(**tokens),
            keys=keys,
        )

    def keys(self, choice: ClipChoice) -> tuple[str, str]:
        """Names of the clip's latents and of its tokens."""
        clip = {"trajectory": self.trajectory(choice.file.path), "frames": list(choice.frames)}
        latents = name_of((clip | {"frames": "all"} if self.whole else clip) | self.given.latents)
        return latents, name_of(clip | {"context": list(choice.context)} | (self.given.tokens or {}))

    def trajectory(self, path: Path) -> str:
        """SHA-256 of a trajectory's file, computed once."""
        if path not in self.hashes:
            self.hashes[path] = file_sha256(path)
        return self.hashes[path]


class Keeper:
    """Completes samples by their latents and tokens, and keeps in the cache what it had to make.

    Args:
        backbone: encodes, on its device.
        maker: of memories, ``None`` without one.
        accelerator: gives the precision of training.
        cache: ``None`` keeps nothing.
    """

    def __init__(
        self, backbone: Backbone, maker: MemoryMaker | None, accelerator: Accelerator, cache: Cache | None
    ) -> None:
        self.backbone, self.maker, self.accelerator, self.cache = backbone, maker, accelerator, cache
        self.asked, self.found = 0, 0

    @staticmethod
    def of(
        recipe: Recipe, backbone: Backbone, maker: MemoryMaker | None, accelerator: Accelerator, cache: Cache | None
    ) -> Keeper | None:
        """The keeper of a run; ``None`` when nothing comes again or its stage trains what encodes."""
        again = recipe.data.clips_per_trajectory or (cache is not None and backbone.frames_alone)
        if not again or backbone.encoding(recipe.stage) is None:
            return None
        return Keeper(backbone, maker, accelerator, cache)

    def complete(self, sample: ClipSample) -> ClipSample:
        """The sample with latents and tokens, without images."""
        self.asked, self.found = self.asked + 1, self.found + (sample.latents is not None)
        cameras = sample.observations.cameras
        images = sample.observations.rgb[:0], sample.observations.depth[:0]
        return replace(
            sample,
            latents=self.latents(sample),
            tokens=self.tokens(sample),
            observations=Observations(*images, cameras),
            context=None,
        )

    def figures(self) -> dict[str, float]:
        """How many of this process's clips came with latents since the start, as a share."""
        return {"latents_found": round(self.found / self.asked, 4)} if self.asked else {}

    def latents(self, sample: ClipSample) -> Tensor:
        """The clip's latents, found or made."""
        if sample.latents is not None:
            return sample.latents
        choice = sample.choice
        whole = self.backbone.frames_alone and self.cache is not None and choice is not None
        if whole and choice is not None:
            sample = replace(sample, observations=choice.file.read().observations)
        with torch.no_grad(), self.accelerator.autocast():
            latents = self.backbone.encode(collate([sample], None, 0))[0].cpu()
        latents = latents[:-1] if whole else latents
        if self.cache is not None and sample.keys is not None:
            self.cache.put(sample.keys[0], {"latents": latents})
        return rows_of(latents, choice, whole) if choice is not None else latents

    def tokens(self, sample: ClipSample) -> MemoryTokens | None:
        """What a memory of the clip's context says, found or made."""
        if sample.tokens is not None or self.maker is None:
            return sample.tokens
        tokens = recall(sample, self.maker, self.backbone.token_budget)
        if self.cache is not None and sample.keys is not None:
            fields = {"features": tokens.features, "positions": tokens.positions, "mask": tokens.mask}
            self.cache.put(sample.keys[1], fields)
        return tokens
