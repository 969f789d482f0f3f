"""A cache of the latents and memory tokens of clips, in a folder that processes and runs share.

An entry is a safetensors file. Its name is its key: a hash of data, weights, settings and versions of packages, on
which its content depends. When code changes and its version does not, the folder must be removed by hand. Two processes
may write an entry at once, because both write the same, aside, and then rename it. Once the folder is full nothing more
is stored; entries are never replaced.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import torch
from accelerate import Accelerator
from torch import Tensor
from torch.utils.data import Dataset

from persist_cli import __version__
from persist_cli.api.backbone import Backbone, Clip, ClipLatents, Clips
from persist_cli.api.observations import Observations
from persist_cli.api.tokens import MemoryTokens
from persist_cli.data.clips import ClipDataset, ClipFrames, ClipSample
from persist_cli.errors import CheckpointError, PersistError
from persist_cli.io.files import ASIDE, file_sha256, read_tensors, write_tensors
from persist_cli.memorize.factory import MemoryFactory, with_memory
from persist_cli.memorize.sources import Source
from persist_cli.plugins import find_plugin
from persist_cli.recipe import MemoryConfig, Recipe
from persist_cli.viewing.console import say

FORMAT: Final = 3  # of the entries; those of another format are not found

SCANS: Final = 64  # how often at most the folder is measured while it fills up

TOKENS: Final = 2  # format of memory tokens; those of 1 have neither colours nor origins and are not found

STALE: Final = 3600.0  # seconds after which a file aside must be that of a killed writer


@dataclass(frozen=True)
class CacheSettings:
    """The place and size of a cache.

    Args:
        folder: the folder of the entries; it is made when missing.
        gigabytes: the size that all entries together may have, in 10⁹ bytes.
    """

    folder: Path
    gigabytes: float


class TensorCache:
    """Keeps tensors by key in a folder, up to a number of bytes.

    The folder is measured at the beginning and whenever this process has added a 64th of the limit. Each of several
    processes can therefore exceed the limit by as much.

    Args:
        settings: the folder and its limit.

    Raises:
        PersistError: when the folder cannot be made or the limit is not a number of at least 0.
    """

    def __init__(self, settings: CacheSettings) -> None:
        self.folder, self.limit = settings.folder, settings.gigabytes * 1e9
        if not self.limit >= 0:
            raise PersistError(f"--cache-gigabytes is {settings.gigabytes}; it must be a number of at least 0")
        self.full = False
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise PersistError(f"{self.folder}: no folder for a cache can be made there ({error.strerror})") from error
        for aside in self.folder.glob(f"*/{ASIDE}*"):
            _remove_stale(aside)
        self.measure()

    def measure(self) -> None:
        """Count the bytes in the folder anew."""
        self.used = sum(_size(path) for path in self.folder.glob("*/*.safetensors"))
        self.added = 0

    def path(self, key: str) -> Path:
        """The file of an entry, which need not exist; entries are spread over 256 folders."""
        return self.folder / key[:2] / f"{key}.safetensors"

    def get(self, key: str) -> dict[str, Tensor] | None:
        """The tensors of an entry, ``None`` when there is none; a damaged one is removed, and a line says so."""
        path = self.path(key)
        if not path.is_file():
            return None
        try:
            tensors, _ = read_tensors(path)
        except CheckpointError as error:
            self._remove(path, str(error))
            return None
        return tensors

    def put(self, key: str, tensors: Mapping[str, Tensor]) -> None:
        """Store an entry while there is room; once the folder cannot be written, nothing more is stored."""
        if self.full:
            return
        path = self.path(key)
        size = sum(tensor.nbytes for tensor in tensors.values())
        if self.added + size > self.limit / SCANS:
            self.measure()
        if self.used + size > self.limit:
            return self._stop(f"full ({self.used / 1e9:.3g} GB)")
        before = _size(path)  # another process may have written the same entry already
        try:
            path.parent.mkdir(exist_ok=True)
            write_tensors(path, tensors)
        except OSError as error:
            return self._stop(f"not writable ({error})")
        grown = _size(path) - before
        self.used, self.added = self.used + grown, self.added + grown

    def _stop(self, cause: str) -> None:
        self.full = True
        say(f"{self.folder}: {cause}; what is not in it is made anew each time")

    def _remove(self, path: Path, cause: str) -> None:
        if path.is_file():  # another process may have removed it
            path.unlink(missing_ok=True)
            say(f"{cause}; removed, made anew")


def cache_key(values: Mapping[str, Any]) -> str:
    """The key of an entry: a hash of the JSON values that it depends on."""
    text = json.dumps(dict(values) | {"format": FORMAT}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:40]


@dataclass(frozen=True)
class ClipKeys:
    """The keys of the entries of one clip.

    Args:
        latents: the key of its latents, or of those of its whole trajectory.
        tokens: the key of its memory tokens, ``None`` without a memory.
    """

    latents: str
    tokens: str | None


@dataclass(frozen=True)
class CacheKeys:
    """Makes the keys of all clips of a run.

    Args:
        latents: the JSON values that latents depend on besides the clip.
        tokens: the JSON values that memory tokens depend on besides the clip, ``None`` without a memory.
        whole_trajectories: whether an entry has the latents of a whole trajectory instead of a clip.
    """

    latents: dict[str, Any]
    tokens: dict[str, Any] | None
    whole_trajectories: bool
    hashes: dict[Path, str] = field(default_factory=dict)  # of the trajectories' files, each computed once

    @staticmethod
    def of(recipe: Recipe, backbone: Backbone, factory: MemoryFactory | None, device: str) -> CacheKeys:
        """The keys of a run.

        Args:
            recipe: the recipe of the run.
            backbone: the backbone, which encodes clips and decides on the number of tokens and the size of images.
            factory: makes the memories, ``None`` without one.
            device: the type of the device that encodes.
        """
        encoded_by = {"persist": __version__, "torch": torch.__version__, "device": device}
        latents = encoded_by | {"encoding": backbone.encoding(), "precision": recipe.training.precision}
        tokens = None
        if factory is not None and recipe.memory is not None:
            tokens = encoded_by | _token_dependencies(recipe.memory, factory, backbone)
            if kept := backbone.token_encoding():
                tokens |= {"kept": kept, "precision": recipe.training.precision}
        return CacheKeys(latents, tokens, backbone.framewise)

    def of_clip(self, frames: ClipFrames) -> ClipKeys:
        """The keys of a clip."""
        clip = {"trajectory": self._file_hash(frames.file.path), "frames": list(frames.frames)}
        latents = cache_key((clip | {"frames": "all"} if self.whole_trajectories else clip) | self.latents)
        if self.tokens is None:
            return ClipKeys(latents, None)
        return ClipKeys(latents, cache_key(clip | {"context": list(frames.context)} | self.tokens))

    def _file_hash(self, path: Path) -> str:
        if path not in self.hashes:
            self.hashes[path] = file_sha256(path)
        return self.hashes[path]


@dataclass(frozen=True)
class ClipCache:
    """A cache of the latents and memory tokens of a run's clips.

    Args:
        cache: the tensors by key.
        keys: makes the keys of the clips.
    """

    cache: TensorCache
    keys: CacheKeys

    @property
    def whole_trajectories(self) -> bool:
        """Whether an entry has the latents of a whole trajectory instead of a clip."""
        return self.keys.whole_trajectories

    def latents(self, frames: ClipFrames) -> ClipLatents | None:
        """The latents of a clip, ``None`` where the cache has none."""
        tensors = self.cache.get(self.keys.of_clip(frames).latents)
        if tensors is None:
            return None
        return self.clip_latents(tensors["video"], frames) if self.whole_trajectories else ClipLatents(**tensors)

    def clip_latents(self, trajectory: Tensor, frames: ClipFrames) -> ClipLatents:
        """The latents of a clip out of those of its whole trajectory, in which every frame was encoded alone."""
        video = trajectory[list(frames.frames)]
        return ClipLatents(video, video[:1])

    def tokens(self, frames: ClipFrames) -> MemoryTokens | None:
        """The memory tokens of a clip, ``None`` where the cache has none."""
        key = self.keys.of_clip(frames).tokens
        tensors = None if key is None else self.cache.get(key)
        return None if tensors is None else MemoryTokens(**tensors)

    def put_latents(self, frames: ClipFrames, latents: ClipLatents) -> None:
        """Store the latents of a clip, or of its whole trajectory, while there is room."""
        tensors = {"video": latents.video} | ({} if self.whole_trajectories else {"image": latents.image})
        self.cache.put(self.keys.of_clip(frames).latents, tensors)

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
        latents, tokens = self.cache.latents(frames), self.cache.tokens(frames)
        sample = self.clips.read(frames, images=latents is None, context=tokens is None)
        return CachedSample(replace(sample, clip=replace(sample.clip, latents=latents, tokens=tokens)), frames)


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
        """The clip with latents in the place of its images."""
        sample = cached.sample
        self.clips += 1
        self.cached_clips += sample.clip.latents is not None
        latents = sample.clip.latents or self._new_latents(sample.clip, cached.frames)
        images = sample.clip.observations
        cameras = Observations(images.rgb[:0], images.depth[:0], images.cameras)
        return replace(cached, sample=replace(sample, clip=replace(sample.clip, observations=cameras, latents=latents)))

    def with_tokens(self, cached: CachedSample) -> Clip:
        """The clip with the tokens that a memory of its context gives for its cameras, where there is a memory."""
        if self.factory is None or cached.sample.clip.tokens is not None:
            return cached.sample.clip
        clip = with_memory(cached.sample, self.factory, self.backbone.token_budget)
        with torch.no_grad(), self.accelerator.autocast():
            tokens = self.backbone.keep_tokens(Clips.stack([clip]))[0]
        if self.cache is not None:
            self.cache.put_tokens(cached.frames, tokens)
        return replace(clip, tokens=tokens)

    def _new_latents(self, clip: Clip, frames: ClipFrames) -> ClipLatents:
        if self.cache is None or self.cache.cache.full:  # a whole trajectory would be encoded again for each clip
            return self._encode(clip)
        if not self.cache.whole_trajectories:
            latents = self._encode(clip)
            self.cache.put_latents(frames, latents)
            return latents
        pieces = Source(frames.file, range(len(frames.file)), str(frames.file.path)).pieces()
        video = torch.cat([self._encode(replace(clip, observations=piece)).video for piece in pieces])
        self.cache.put_latents(frames, ClipLatents(video, video[:1]))
        return self.cache.clip_latents(video, frames)

    def _encode(self, clip: Clip) -> ClipLatents:
        """Latents of these frames, on the CPU."""
        with torch.no_grad(), self.accelerator.autocast():
            return self.backbone.encode(Clips.stack([clip]))[0].to("cpu")


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except FileNotFoundError:  # another process may have removed it
        return 0


def _remove_stale(aside: Path) -> None:
    try:
        if time.time() - aside.stat().st_mtime > STALE:
            shutil.rmtree(aside, ignore_errors=True)
    except FileNotFoundError:  # its writer may have renamed it
        return


def _token_dependencies(memory: MemoryConfig, factory: MemoryFactory, backbone: Backbone) -> dict[str, Any]:
    """The JSON values that memory tokens depend on; the features of a fixed picture stand for the encoder's weights."""
    height, width = backbone.image_size
    picture = torch.arange(height * width * 3).reshape(1, height, width, 3) * 37 % 256
    features = factory.encoder.encode(picture.to(torch.uint8)).float().cpu().contiguous().numpy().data
    plugins = [find_plugin("memory", memory.name), find_plugin("encoder", memory.encoder)]
    return {
        "tokens": TOKENS,
        "memory": memory.name,
        "settings": dataclasses.asdict(factory.settings),
        "encoder": memory.encoder,
        "encoder_settings": dataclasses.asdict(factory.encoder.settings),
        "features": hashlib.sha256(features).hexdigest(),
        "budget": backbone.token_budget,
        "packages": [[plugin.package, plugin.version] for plugin in plugins],
    }
