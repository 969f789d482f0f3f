"""Training on own writes: a clip begins where the model's own prediction of the frames before it ends.

A rollout reads from its memory what it imagined itself, and goes on from its own last frame; a model that was trained
on true frames alone takes every small error for the truth, and the errors add up. So for some samples the frames before
the clip are predicted by the model as it is now, in one step and without gradients, and written by the path that a
rollout writes by (the idea of DIAMOND's 3D branch, 2405.12399, and of Self Forcing, 2506.08009, at the cost of one more
forward pass). Only the clip itself counts for the loss.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from persist_cli.api.backbone import Clip, Clips
from persist_cli.api.clips import ClipLatents
from persist_cli.api.memory import Memory
from persist_cli.api.observations import Observations, Origin
from persist_cli.data.writing_noise import WritingNoise
from persist_cli.memorize.factory import memory_of
from persist_cli.train.clip_cache import CachedSample, ClipEncoder


@dataclass
class Chain:
    """A sample whose segments are predicted one after the other.

    Args:
        cached: the sample, with latents.
        memory: the memory of its context, to which the predicted frames are added; ``None`` in stage 1.
        draws: generator of the errors of what is written.
        given: the last predicted frame, once there is one.
    """

    cached: CachedSample
    memory: Memory | None
    draws: torch.Generator
    given: Observations | None = None


@dataclass(frozen=True)
class OwnWrites:
    """Predicts the segments before the clips of chained samples.

    Args:
        encoder: the encoder of the run's clips, with its backbone, memories and cache.
        noise: errors of the frames that are written.
    """

    encoder: ClipEncoder
    noise: WritingNoise

    def written(self, samples: Sequence[CachedSample]) -> list[CachedSample]:
        """Return the samples; the chained ones remember the model's own frames and begin with the last of them.

        Args:
            samples: samples with latents.
        """
        chains = {number: self._begin(cached) for number, cached in enumerate(samples) if cached.sample.before}
        for segment in range(max((len(chain.cached.sample.before) for chain in chains.values()), default=0)):
            self._predict([*chains.values()], segment)
        return [self._end(chains[number]) if number in chains else cached for number, cached in enumerate(samples)]

    def _begin(self, cached: CachedSample) -> Chain:
        encoder, memory = self.encoder, None
        if encoder.factory is not None:
            encoder.bring_features(cached.frames)
            memory = memory_of(cached.sample, encoder.factory)
            if encoder.cache is not None and cached.sample.remembered is None:
                encoder.cache.put_memory(cached.frames, memory.tensors())
        return Chain(cached, memory, torch.Generator().manual_seed(errors_seed(cached.frames.seed)))

    def _predict(self, chains: Sequence[Chain], segment: int) -> None:
        """Predict the frames of one segment of all chains, and write them."""
        encoder = self.encoder
        clips = [self._clip(chain, chain.cached.sample.before[segment]) for chain in chains]
        with encoder.accelerator.autocast():
            rgb, depth = encoder.backbone.predict_once(Clips.stack(clips).to(encoder.accelerator.device))
        for chain, clip, colors, metres in zip(chains, clips, rgb, depth, strict=True):
            seen = Observations(colors[1:], metres[1:], clip.observations.cameras[1:]).with_origin(Origin.IMAGINED)
            chain.given = seen[-1:]
            if chain.memory is not None and encoder.factory is not None:
                chain.memory.memorize(self.noise.disturb(seen, chain.draws).to(encoder.factory.device))

    def _clip(self, chain: Chain, clip: Clip) -> Clip:
        """Return a segment with the given frame of its chain, and with the tokens of its memory."""
        if chain.given is not None and clip.latents is not None:
            first = self.encoder.encode(replace(clip, observations=chain.given, latents=None))
            clip = replace(clip, latents=ClipLatents(clip.latents.video, first.image))
        if chain.memory is None or self.encoder.factory is None:
            return clip
        cameras = clip.observations.cameras
        chain.memory.foresee([cameras])
        tokens = chain.memory.recall([cameras], self.encoder.backbone.token_budget)[0]
        return replace(clip, tokens=tokens.to(self.encoder.factory.device))

    def _end(self, chain: Chain) -> CachedSample:
        """Return the sample with the given frame of its chain; its memory is read like that of any sample."""
        sample = chain.cached.sample
        clip = self._clip(replace(chain, memory=None), sample.clip)
        remembered = None if chain.memory is None else chain.memory.tensors()
        return replace(chain.cached, sample=replace(sample, clip=clip, before=(), context=None, remembered=remembered))


def errors_seed(seed: int) -> int:
    """Return the seed of the errors of a sample's written frames, another one than that of its clip's noise."""
    return int(np.random.SeedSequence((seed, 1)).generate_state(1)[0])
