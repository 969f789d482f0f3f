"""What training keeps of clips between steps and runs: latents and memory tokens in a folder that processes share.

An entry is a safetensors file named by its key, a hash of what its content depends on as far as that can be named:
data, weights, settings, versions of packages. Code that changed and kept its version is not told apart; then the folder
must be removed. Entries are written aside and renamed: two writers of one key write the same. What does not fit any
more is not stored; nothing is ever pushed out.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
import time
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

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

FORMAT = 2  # of the entries; another number makes every older one unknown

SCANS = 64  # how often at most the folder is measured while it fills up

STALE = 3600.0  # seconds after which what lies aside was left by a killed writer


@dataclass(frozen=True)
class CacheSettings:
    """Where and how much.

    Args:
        folder: made when missing.
        gigabytes: 10⁹ bytes that its entries may fill.
    """

    folder: Path
    gigabytes: float


def cache_key(values: Mapping[str, Any]) -> str:
    """The key of an entry: a hash of what it depends on, JSON values."""
    text = json.dumps(dict(values) | {"format": FORMAT}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:40]


class Cache:
    """Tensors by key in a folder, bounded in bytes.

    Its size is measured when it is opened and whenever this process has added a 64th of the bound since: other
    writers can pass the bound by as much each.

    Args:
        settings: folder and bound.

    Raises:
        PersistError: when the folder cannot be made or the bound is no number.
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
        """Where the entry is or would be; 256 folders share them."""
        return self.folder / key[:2] / f"{key}.safetensors"

    def get(self, key: str) -> dict[str, Tensor] | None:
        """The entry, ``None`` when there is none; a damaged one is removed with one line."""
        path = self.path(key)
        if not path.is_file():
            return None
        try:
            tensors, metadata = read_tensors(path)
        except CheckpointError as error:
            self._throw_away(path, str(error))
            return None
        if metadata.get("crc32") != _checksum(tensors):
            self._throw_away(path, f"{path}: its checksum is wrong")
            return None
        return tensors

    def put(self, key: str, tensors: Mapping[str, Tensor]) -> None:
        """Store an entry while there is room; a folder that cannot be written ends the storing, not the run."""
        if self.full:
            return
        path = self.path(key)
        size = sum(tensor.nbytes for tensor in tensors.values())
        if self.added + size > self.limit / SCANS:
            self.measure()
        if self.used + size > self.limit:
            return self._stop(f"full ({self.used / 1e9:.3g} GB)")
        before = _size(path)  # of the same entry, when another process was faster
        try:
            path.parent.mkdir(exist_ok=True)
            write_tensors(path, tensors, {"crc32": _checksum(tensors)})
        except OSError as error:
            return self._stop(f"not writable ({error})")
        grown = _size(path) - before
        self.used, self.added = self.used + grown, self.added + grown

    def _stop(self, cause: str) -> None:
        self.full = True
        say(f"{self.folder}: {cause}; what is not in it is made anew each time")

    def _throw_away(self, path: Path, cause: str) -> None:
        if path.is_file():  # another process may have been faster
            path.unlink(missing_ok=True)
            say(f"{cause}; removed, made anew")


def _checksum(tensors: Mapping[str, Tensor]) -> str:
    """CRC-32 of the tensors' bytes, in order of their names."""
    code = 0
    for _, tensor in sorted(tensors.items()):
        code = zlib.crc32(tensor.detach().cpu().reshape(-1).view(torch.uint8).numpy().data, code)
    return f"{code:08x}"


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except FileNotFoundError:  # removed in between by another process
        return 0


def _remove_stale(aside: Path) -> None:
    try:
        if time.time() - aside.stat().st_mtime > STALE:
            shutil.rmtree(aside, ignore_errors=True)
    except FileNotFoundError:  # a writer that lives has renamed it
        return


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
    def of(recipe: Recipe, backbone: Backbone, maker: MemoryFactory | None, device: str) -> CacheKeys:
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
        return CacheKeys(latents, tokens, backbone.framewise)

    def of_clip(self, choice: ClipFrames) -> ClipKeys:
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


def _of_memory(choice: MemoryConfig, maker: MemoryFactory, backbone: Backbone) -> dict[str, Any]:
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

    def latents(self, choice: ClipFrames) -> ClipLatents | None:
        """Latents of the clip, ``None`` where there are none."""
        tensors = self.cache.get(self.keys.of_clip(choice).latents)
        if tensors is None:
            return None
        return self.cut(tensors["video"], choice) if self.whole else ClipLatents(**tensors)

    def cut(self, video: Tensor, choice: ClipFrames) -> ClipLatents:
        """The clip's latents out of those of its whole trajectory, every frame of which was encoded alone."""
        frames = video[list(choice.frames)]
        return ClipLatents(frames, frames[:1])

    def tokens(self, choice: ClipFrames) -> MemoryTokens | None:
        """Memory tokens of the clip, ``None`` where there are none."""
        key = self.keys.of_clip(choice).tokens
        found = None if key is None else self.cache.get(key)
        return None if found is None else MemoryTokens(**found)

    def put_latents(self, choice: ClipFrames, latents: ClipLatents) -> None:
        """Store the clip's latents, or those of its whole trajectory, while there is room."""
        tensors = {"video": latents.video} | ({} if self.whole else {"image": latents.image})
        self.cache.put(self.keys.of_clip(choice).latents, tensors)

    def put_tokens(self, choice: ClipFrames, tokens: MemoryTokens) -> None:
        """Store the clip's memory tokens while there is room."""
        key = self.keys.of_clip(choice).tokens
        if key is not None:
            fields = {"features": tokens.features, "positions": tokens.positions, "mask": tokens.mask}
            self.cache.put(key, fields)


@dataclass(frozen=True)
class CachedSample:
    """A training clip, with the latents and tokens that a cache has of it.

    Args:
        sample: the clip, without the images and the context that nothing has to be made of any more.
        frames: which frames of which trajectory it is made of.
    """

    sample: ClipSample
    frames: ClipFrames


class CachedClips(Dataset[CachedSample]):
    """Clips with the latents and tokens that a cache has of them; of those, no image is read.

    Args:
        clips: the clips.
        cache: ``None`` has nothing.
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
    """Completes clips by latents and memory tokens; those that the cache lacks are made of each clip alone, and stored.

    Args:
        backbone: encodes, on its device.
        factory: of memories, ``None`` without one.
        accelerator: gives the precision of training.
        cache: ``None`` stores nothing.
    """

    def __init__(
        self, backbone: Backbone, factory: MemoryFactory | None, accelerator: Accelerator, cache: ClipCache | None
    ) -> None:
        self.backbone, self.factory, self.accelerator, self.cache = backbone, factory, accelerator, cache
        self.clips, self.cached = 0, 0  # how many there were, and how many of them came with latents

    def figures(self) -> dict[str, float]:
        """How many of this process's clips came with latents since the start, as a share."""
        return {"latents_found": round(self.cached / self.clips, 4)} if self.clips else {}

    def with_latents(self, cached: CachedSample) -> CachedSample:
        """The clip with its latents, which stand for its images."""
        sample = cached.sample
        self.clips, self.cached = self.clips + 1, self.cached + (sample.clip.latents is not None)
        latents = sample.clip.latents or self._new_latents(sample.clip, cached.frames)
        seen = sample.clip.observations
        cameras = Observations(seen.rgb[:0], seen.depth[:0], seen.cameras)
        return replace(cached, sample=replace(sample, clip=replace(sample.clip, observations=cameras, latents=latents)))

    def with_tokens(self, cached: CachedSample) -> Clip:
        """The clip with what a memory of its context says to its cameras, if there is a memory."""
        if self.factory is None or cached.sample.clip.tokens is not None:
            return cached.sample.clip
        clip = with_memory(cached.sample, self.factory, self.backbone.token_budget)
        if self.cache is not None and clip.tokens is not None:
            self.cache.put_tokens(cached.frames, clip.tokens)
        return clip

    def _new_latents(self, clip: Clip, frames: ClipFrames) -> ClipLatents:
        if self.cache is None or self.cache.cache.full:  # a whole trajectory would be encoded again for each clip
            return self._encode(clip)
        if not self.cache.whole:
            latents = self._encode(clip)
            self.cache.put_latents(frames, latents)
            return latents
        pieces = Source(frames.file, range(len(frames.file)), str(frames.file.path)).pieces()
        video = torch.cat([self._encode(replace(clip, observations=piece)).video for piece in pieces])
        self.cache.put_latents(frames, ClipLatents(video, video[:1]))
        return self.cache.cut(video, frames)

    def _encode(self, clip: Clip) -> ClipLatents:
        """Latents of these frames, on the CPU."""
        with torch.no_grad(), self.accelerator.autocast():
            return self.backbone.encode(Clips.stack([clip]))[0].to("cpu")
