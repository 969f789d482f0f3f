"""A cache of what is made of clips: their latents and memory tokens, and the features of whole trajectories."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

import torch
from accelerate import Accelerator
from torch import Tensor
from torch.utils.data import Dataset

from persist_cli import __version__
from persist_cli.api.backbone import Backbone, Clip, Clips
from persist_cli.api.clips import ClipLatents
from persist_cli.api.encoder import Encoder
from persist_cli.api.memory import FrameOfReference
from persist_cli.api.observations import Observations
from persist_cli.api.scene import Scene
from persist_cli.api.tokens import MemoryTokens
from persist_cli.checkpoints.scene_models import find_scene_model
from persist_cli.data.clips import ClipDataset, ClipFrames, ClipSample
from persist_cli.data.file_hashes import FileHashes
from persist_cli.data.writing_noise import WritingNoise
from persist_cli.memorize.factory import MemoryFactory, with_memory
from persist_cli.memorize.kept_features import KeptFeatures
from persist_cli.memorize.sources import Source
from persist_cli.plugin_code import code_of
from persist_cli.plugins import find_plugin
from persist_cli.recipe import MemoryConfig, Recipe
from persist_cli.train.feature_cache import FeatureCache
from persist_cli.train.tensor_cache import ROWS, TensorCache, cache_key

TOKENS: Final = 2  # format of memory tokens; those of 1 have neither colours nor origins and are not found


# what the features of a frame depend on, among all that tokens depend on
FEATURES: Final = frozenset(
    ("persist", "torch", "device", "encoder", "encoder_settings", "features", "packages", "encoder_code")
)


@dataclass(frozen=True)
class ClipKeys:
    """The keys of the entries of one clip.

    Args:
        latents: the key of its latents, or of those of its whole trajectory; ``None`` where neither comes again.
        tokens: the key of its memory tokens, ``None`` without a memory or where the clip does not come again.
        memory: the key of the memory of its context, ``None`` like that of the tokens.
    """

    latents: str | None
    tokens: str | None
    memory: str | None = None


@dataclass(frozen=True, kw_only=True)
class CacheKeys:
    """Makes the keys of all clips of a run.

    Args:
        latents: the JSON values that latents depend on besides the clip.
        tokens: the JSON values that memory tokens depend on besides the clip, ``None`` without a memory.
        whole_trajectories: whether an entry has the latents of a whole trajectory instead of a clip.
        repeats: whether clips come again, with the same contexts.
        hashes: those of the trajectories' files.
    """

    latents: dict[str, Any]
    tokens: dict[str, Any] | None
    whole_trajectories: bool
    repeats: bool = True
    hashes: FileHashes = field(default_factory=FileHashes)

    @staticmethod
    def of(recipe: Recipe, backbone: Backbone, factory: MemoryFactory | None, device: str, precision: str) -> CacheKeys:
        """The keys of a run.

        Args:
            recipe: the recipe of the run.
            backbone: the backbone, which encodes clips and decides on the number of tokens and the size of images.
            factory: makes the memories, ``None`` without one.
            device: the type of the device that encodes.
            precision: in which it encodes: accelerate's, which is ``no`` for DeepSpeed whatever the recipe's.
        """
        encoded_by = {"persist": __version__, "torch": torch.__version__, "device": device}
        encoding = {"precision": precision} | _code_of("backbone", backbone.name)
        latents = encoded_by | {"encoding": backbone.encoding()} | encoding
        tokens = None
        if factory is not None and recipe.memory is not None:
            tokens = encoded_by | _token_dependencies(recipe.memory, factory, backbone)
            if kept := backbone.token_encoding():
                tokens |= {"kept": kept} | encoding
            if noise := WritingNoise.of(recipe.data):
                tokens |= {"noise": dataclasses.asdict(noise)}
        return CacheKeys(
            latents=latents, tokens=tokens, whole_trajectories=backbone.framewise,
            repeats=recipe.data.clips_per_trajectory > 0,
        )  # fmt: skip

    def whole(self, frames: ClipFrames) -> bool:
        """Whether the entry of a clip has the latents of its whole trajectory; views of a clip have their own."""
        return self.whole_trajectories and frames.view is None

    def of_clip(self, frames: ClipFrames) -> ClipKeys:
        """The keys of a clip."""
        clip: dict[str, Any] = {"trajectory": self.hashes.of(frames.file), "frames": list(frames.frames)}
        if frames.view is not None:
            clip["view"] = frames.view.to_json()
        latents = tokens = memory = None
        if self.whole(frames):
            latents = cache_key(clip | {"frames": "all"} | ROWS | self.latents)
        elif self.repeats:
            latents = cache_key(clip | self.latents)
        if self.repeats and self.tokens is not None:
            context: dict[str, Any] = {"context": list(frames.context)}
            context |= {"errors": frames.noise_seed} if frames.noise_seed else {}
            context = {"cells": frames.segments()[0].frames[0]} if frames.true_cells else context
            tokens = cache_key(clip | context | self.tokens)
            memory = cache_key(clip | {"frames": "memory"} | context | self.tokens)
        return ClipKeys(latents, tokens, memory)


@dataclass(frozen=True)
class ClipCache:
    """A cache of the latents and memory tokens of a run's clips, and of the features of their trajectories.

    Args:
        cache: the tensors by key.
        keys: makes the keys of the clips.
        features: the features of whole trajectories, ``None`` where frames are encoded as quickly as they are read.
    """

    cache: TensorCache
    keys: CacheKeys
    features: FeatureCache | None = None

    @staticmethod
    def of(cache: TensorCache, keys: CacheKeys, factory: MemoryFactory | None) -> ClipCache:
        """The cache of a run; a costly encoder's features and the hashes of files are kept in it too."""
        keys = replace(keys, hashes=cache.hashes)
        encoder = None if factory is None else factory.encoder
        if not isinstance(encoder, KeptFeatures) or keys.tokens is None:
            return ClipCache(cache, keys)
        depends = {name: value for name, value in keys.tokens.items() if name in FEATURES}
        return ClipCache(cache, keys, FeatureCache(cache, depends, encoder))

    def latents(self, frames: ClipFrames) -> ClipLatents | None:
        """The latents of a clip, ``None`` where the cache has none."""
        key = self.keys.of_clip(frames).latents
        rows = frames.frames if self.keys.whole(frames) else None
        tensors = None if key is None else self.cache.get(key, rows)
        if tensors is None:
            return None
        return ClipLatents(**tensors) if rows is None else framewise_latents(tensors["video"])

    def tokens(self, frames: ClipFrames) -> MemoryTokens | None:
        """The memory tokens of a clip, ``None`` where the cache has none."""
        key = self.keys.of_clip(frames).tokens
        tensors = None if key is None else self.cache.get(key)
        return None if tensors is None else MemoryTokens(**tensors)

    def memory(self, frames: ClipFrames) -> dict[str, Tensor] | None:
        """The tensors of a memory of a clip's context, ``None`` where the cache has none."""
        key = self.keys.of_clip(frames).memory
        return None if key is None else self.cache.get(key)

    def put_memory(self, frames: ClipFrames, tensors: Mapping[str, Tensor]) -> None:
        """Store the tensors of a memory of a clip's context while there is room; an empty one is made at once."""
        key = self.keys.of_clip(frames).memory
        if key is not None and tensors:
            self.cache.put(key, tensors)

    def put_latents(self, frames: ClipFrames, latents: ClipLatents) -> None:
        """Store the latents of a clip, or of its whole trajectory, while there is room."""
        key = self.keys.of_clip(frames).latents
        if key is not None and self.keys.whole(frames):
            self.cache.put_rows(key, {"video": latents.video})
        elif key is not None:
            self.cache.put(key, {"video": latents.video, "image": latents.image})

    def put_tokens(self, frames: ClipFrames, tokens: MemoryTokens) -> None:
        """Store the memory tokens of a clip while there is room."""
        key = self.keys.of_clip(frames).tokens
        if key is not None:
            self.cache.put(key, tokens.tensors())


@dataclass(frozen=True)
class CachedSample:
    """A training clip with the latents and tokens that a cache has of it.

    Args:
        sample: the clip, without images where it has latents and without context where it has tokens.
        frames: its frames and their trajectory.
    """

    sample: ClipSample
    frames: ClipFrames


class CachedClips(Dataset[CachedSample]):
    """Reads clips with the latents and tokens that a cache has of them; images that these stand for are not read.

    Args:
        clips: the clips.
        cache: the cache, ``None`` for none.
    """

    def __init__(self, clips: ClipDataset, cache: ClipCache | None) -> None:
        self.clips, self.cache = clips, cache

    def __getitem__(self, number: int) -> CachedSample:
        frames = self.clips.choose(number)
        if self.cache is None:
            return CachedSample(self.clips.read(frames), frames)
        latents = [self.cache.latents(segment) for segment in frames.segments()]
        # the memory of a chained sample gets more frames before it is read
        tokens, memory = (None, self.cache.memory(frames)) if frames.before else (self.cache.tokens(frames), None)
        sample = self.clips.read(frames, any(part is None for part in latents), tokens is None and memory is None)
        clips = zip((*sample.before, sample.clip), latents, strict=True)
        *before, clip = (replace(clip, latents=known) for clip, known in clips)
        sample = replace(sample, clip=replace(clip, tokens=tokens), before=tuple(before), remembered=memory)
        return CachedSample(sample, frames)


class ClipEncoder:
    """Completes clips by latents and memory tokens; those that the cache lacks are made for each clip and stored.

    Args:
        backbone: the backbone, which encodes on its own device.
        factory: makes the memories, ``None`` without one.
        accelerator: accelerate for this process, which gives the precision of training.
        cache: the cache, ``None`` for none.
    """

    def __init__(
        self, backbone: Backbone, factory: MemoryFactory | None, accelerator: Accelerator, cache: ClipCache | None
    ) -> None:
        self.backbone, self.factory, self.accelerator, self.cache = backbone, factory, accelerator, cache
        self.clips = self.cached_clips = 0  # clips so far, and how many of them came with latents

    def figures(self) -> dict[str, float]:
        """The share of this process's clips that came with latents, empty before the first clip."""
        return {"latents_found": round(self.cached_clips / self.clips, 4)} if self.clips else {}

    def with_latents(self, cached: CachedSample) -> CachedSample:
        """The clip, and the segments before it, with latents in the place of their images."""
        sample = cached.sample
        self.clips += 1
        self.cached_clips += sample.clip.latents is not None
        clips = zip((*sample.before, sample.clip), cached.frames.segments(), strict=True)
        *before, clip = (self._encoded(clip, frames) for clip, frames in clips)
        return replace(cached, sample=replace(sample, clip=clip, before=tuple(before)))

    def _encoded(self, clip: Clip, frames: ClipFrames) -> Clip:
        latents = clip.latents or self._new_latents(clip, frames)
        images = clip.observations
        cameras = Observations(images.rgb[:0], images.depth[:0], images.cameras)
        return replace(clip, observations=cameras, latents=latents)

    def with_tokens(self, cached: CachedSample) -> Clip:
        """The clip with the tokens that a memory of its context gives for its cameras, where there is a memory."""
        if self.factory is None or cached.sample.clip.tokens is not None:
            return cached.sample.clip
        self.bring_features(cached.frames)
        clip = with_memory(cached.sample, self.factory, self.backbone.token_budget)
        with torch.no_grad(), self.accelerator.autocast():
            tokens = self.backbone.keep_tokens(Clips.stack([clip]))[0]
        if self.cache is not None and not cached.frames.before:
            self.cache.put_tokens(cached.frames, tokens)
        return replace(clip, tokens=tokens)

    def bring_features(self, frames: ClipFrames) -> None:
        """Let a costly encoder know the features of a clip's context, where the cache keeps them."""
        if self.cache is not None and self.cache.features is not None and frames.view is None:
            self.cache.features.bring(frames.file, frames.context)

    def _new_latents(self, clip: Clip, frames: ClipFrames) -> ClipLatents:
        if self.cache is None or self.cache.cache.full:  # a whole trajectory would be encoded again for each clip
            return self.encode(clip)
        if not self.cache.keys.whole(frames):
            latents = self.encode(clip)
            self.cache.put_latents(frames, latents)
            return latents
        known = self.cache.latents(frames)  # those of its trajectory may be there by now
        if known is not None:
            return known
        pieces = Source(frames.file, range(len(frames.file)), str(frames.file.path)).pieces()
        video = torch.cat([self.encode(replace(clip, observations=piece)).video for piece in pieces])
        self.cache.put_latents(frames, framewise_latents(video))
        return framewise_latents(video[list(frames.frames)])

    def encode(self, clip: Clip) -> ClipLatents:
        """Latents of these frames, on the CPU."""
        with torch.no_grad(), self.accelerator.autocast():
            return self.backbone.encode(Clips.stack([clip]))[0].to("cpu")


def framewise_latents(video: Tensor) -> ClipLatents:
    """Latents of a codec that codes every frame alone, in which the first frame is what it is by itself."""
    return ClipLatents(video, video[:1])


def _token_dependencies(memory: MemoryConfig, factory: MemoryFactory, backbone: Backbone) -> dict[str, Any]:
    """The JSON values that memory tokens depend on; the features of a fixed picture stand for the encoder's weights."""
    plugins = [find_plugin("memory", memory.name), find_plugin("encoder", memory.encoder)]
    return {
        "tokens": TOKENS,
        "memory": memory.name,
        "settings": dataclasses.asdict(factory.settings),
        "encoder": memory.encoder,
        "encoder_settings": dataclasses.asdict(factory.encoder.settings),
        "features": _features_hash(factory.encoder, backbone) if factory.encoder.reads_images else "",
        "budget": backbone.token_budget,
        **_imagined_by(factory),
        "packages": [[plugin.package, plugin.version] for plugin in plugins],
        **_code_of("memory", memory.name),
        **_code_of("encoder", memory.encoder),
    }


def _code_of(kind: str, name: str) -> dict[str, str]:
    """The code of a plugin under a key of its kind; nothing for one of persist's own."""
    code = code_of(kind, name)
    return {} if code is None else {f"{kind}_code": code}


def _imagined_by(factory: MemoryFactory) -> dict[str, Any]:
    """The hash of the model that imagines in the memories, and its code where that is of another package."""
    memory = factory.kind(factory.settings, factory.encoder, FrameOfReference(""))
    name = memory.wanted_model if isinstance(memory, Scene) else None
    if not name:
        return {}
    model = find_scene_model(name)
    return {"imagined_by": model.fingerprint} | _code_of("scene model", model.plugin)


def _features_hash(encoder: Encoder, backbone: Backbone) -> str:
    """A hash of the features of a picture of the backbone's size."""
    height, width = backbone.image_size
    picture = torch.arange(height * width * 3).reshape(1, height, width, 3) * 37 % 256
    features = encoder.encoded(picture.to(torch.uint8)).float().cpu().contiguous()
    return hashlib.sha256(features.numpy().data).hexdigest()
