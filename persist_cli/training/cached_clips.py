"""Clips that come again: what was made of one of them once is taken from the cache, what is missing is made and stored.

Everything is made of one clip alone, never of a batch, so that it does not depend on which clips stand beside it: a
step of cached clips equals one of clips that are encoded on the spot. Where a codec codes every frame alone, latents
are stored of whole trajectories instead and serve every clip that can be cut from them, at any stride; such a step
equals one without a cache up to the rounding of larger batches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from accelerate import Accelerator
from torch import Tensor
from torch.utils.data import Dataset

from persist_cli.memorizing.recall import MemoryMaker, collate, recall
from persist_cli.memorizing.sources import Source
from persist_cli.training.cache import Cache
from persist_cli.training.keys import CacheKeys
from persist_cli.trajectories.clips import ClipChoice, ClipDataset, ClipSample
from persist_cli.world.backbone import Backbone
from persist_cli.world.observations import Observations
from persist_cli.world.tokens import MemoryTokens


@dataclass(frozen=True)
class ClipCache:
    """A cache of what is made of clips.

    Args:
        cache: tensors by key.
        keys: of the clips.
    """

    cache: Cache
    keys: CacheKeys

    @property
    def whole(self) -> bool:
        """Whether it takes latents of whole trajectories."""
        return self.keys.whole

    def latents(self, choice: ClipChoice) -> Tensor | None:
        """Latents of the clip, ``None`` where there are none."""
        found = self.cache.get(self.keys.of_clip(choice).latents)
        return None if found is None else self.cut(found["latents"], choice)

    def cut(self, latents: Tensor, choice: ClipChoice) -> Tensor:
        """The clip's latents of those that are stored."""
        return latents[list(choice.frames)] if self.whole else latents

    def tokens(self, choice: ClipChoice) -> MemoryTokens | None:
        """Memory tokens of the clip, ``None`` where there are none."""
        key = self.keys.of_clip(choice).tokens
        found = None if key is None else self.cache.get(key)
        return None if found is None else MemoryTokens(**found)

    def put_latents(self, choice: ClipChoice, latents: Tensor) -> None:
        """Store the clip's latents, or those of its whole trajectory, while there is room."""
        self.cache.put(self.keys.of_clip(choice).latents, {"latents": latents})

    def put_tokens(self, choice: ClipChoice, tokens: MemoryTokens) -> None:
        """Store the clip's memory tokens while there is room."""
        key = self.keys.of_clip(choice).tokens
        if key is not None:
            fields = {"features": tokens.features, "positions": tokens.positions, "mask": tokens.mask}
            self.cache.put(key, fields)


@dataclass(frozen=True)
class CachedSample:
    """A clip with what a cache has of it.

    Args:
        clip: without the images and the context that nothing has to be made of.
        choice: which frames it is made of.
        latents: what ``Backbone.encode`` gives of this clip alone, without a batch axis, where the cache has it.
        tokens: what a memory of the context says to the clip's cameras, where the cache has it.
    """

    clip: ClipSample
    choice: ClipChoice
    latents: Tensor | None = None
    tokens: MemoryTokens | None = None


class CachedClips(Dataset[CachedSample]):
    """Clips with the latents and tokens that a cache has of them; of those, no image is read.

    Args:
        clips: the clips.
        cache: ``None`` has nothing.
    """

    def __init__(self, clips: ClipDataset, cache: ClipCache | None) -> None:
        self.clips, self.cache = clips, cache

    def __getitem__(self, number: int) -> CachedSample:
        choice = self.clips.choose(number)
        if self.cache is None:
            return CachedSample(self.clips.read(choice), choice)
        latents, tokens = self.cache.latents(choice), self.cache.tokens(choice)
        clip = self.clips.read(choice, images=latents is None, context=tokens is None)
        return CachedSample(clip, choice, latents, tokens)


class ClipEncoder:
    """Makes batches of latents and memory tokens; those that the cache lacks are made of each clip alone, and stored.

    Args:
        backbone: encodes, on its device.
        maker: of memories, ``None`` without one.
        accelerator: gives the precision of training.
        cache: ``None`` stores nothing.
    """

    def __init__(
        self, backbone: Backbone, maker: MemoryMaker | None, accelerator: Accelerator, cache: ClipCache | None
    ) -> None:
        self.backbone, self.maker, self.accelerator, self.cache = backbone, maker, accelerator, cache
        self.asked, self.found = 0, 0

    def all_latents(self, samples: Sequence[CachedSample]) -> Tensor:
        """Latents of all the clips as a batch."""
        self.asked += len(samples)
        self.found += sum(sample.latents is not None for sample in samples)
        return torch.stack([self.latents(sample) for sample in samples])

    def all_tokens(self, samples: Sequence[CachedSample]) -> MemoryTokens | None:
        """Memory tokens of all the clips as a batch; ``None`` without a memory."""
        maker = self.maker
        return None if maker is None else MemoryTokens.stack([self.tokens(sample, maker) for sample in samples])

    def without_images(self, samples: Sequence[CachedSample]) -> list[ClipSample]:
        """The clips without the images, which latents stand for."""
        return [_without_images(sample.clip) for sample in samples]

    def figures(self) -> dict[str, float]:
        """How many of this process's clips came with latents since the start, as a share."""
        return {"latents_found": round(self.found / self.asked, 4)} if self.asked else {}

    def latents(self, sample: CachedSample) -> Tensor:
        """The clip's latents, found or made."""
        if sample.latents is not None:
            return sample.latents
        cache, choice = self.cache, sample.choice
        if cache is None or cache.cache.full:  # a whole trajectory would be encoded again for each of its clips
            return self.encode(sample.clip)
        if cache.whole:
            pieces = Source(choice.file, range(len(choice.file)), str(choice.file.path)).pieces()
            latents = torch.cat([self.encode(replace(sample.clip, observations=piece)) for piece in pieces])
        else:
            latents = self.encode(sample.clip)
        cache.put_latents(choice, latents)
        return cache.cut(latents, choice)

    def encode(self, clip: ClipSample) -> Tensor:
        """Latents of these frames, on the CPU."""
        with torch.no_grad(), self.accelerator.autocast():
            return self.backbone.encode(collate([clip]))[0].cpu()

    def tokens(self, sample: CachedSample, maker: MemoryMaker) -> MemoryTokens:
        """What a memory of the clip's context says, found or made."""
        if sample.tokens is not None:
            return sample.tokens
        tokens = recall(sample.clip, maker, self.backbone.token_budget)
        if self.cache is not None:
            self.cache.put_tokens(sample.choice, tokens)
        return tokens


def _without_images(clip: ClipSample) -> ClipSample:
    seen = clip.observations
    return replace(clip, observations=Observations(seen.rgb[:0], seen.depth[:0], seen.cameras), context=None)
