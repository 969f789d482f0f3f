"""A cache of clips: cached training is training to the bit, and keys say all that entries depend on."""

from __future__ import annotations

import errno
import json
import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from accelerate import Accelerator

from persist_cli.api.clips import ClipLatents
from persist_cli.api.tokens import MemoryTokens
from persist_cli.data import file_hashes, store
from persist_cli.data.augment import View
from persist_cli.data.clips import ClipDataset, ClipPlan
from persist_cli.errors import PersistError
from persist_cli.io.files import ASIDE, read_tensors
from persist_cli.memorize import sources
from persist_cli.plugins import make_backbone
from persist_cli.train.clip_cache import CachedClips, CacheKeys, ClipCache, ClipEncoder
from persist_cli.train.tensor_cache import STALE, CacheSettings, TensorCache, cache_key
from tests.support.disk import file_limit
from tests.support.micro_runs import MICRO, MICRO_SETTINGS, SIZE, equal_runs, losses, stage
from tests.support.processes import start_persist

FEW = "data.clips_per_trajectory=3"

STILL = (
    "backbone.settings.vae={block_out_channels: [8, 8, 8], layers_per_block: 1, norm_num_groups: 4, "
    "latent_channels: 4, "
)

FRAMEWISE = ["base=null", *MICRO_SETTINGS, STILL + "temporal_compression_ratio: 1}"]

TOKENS = {"features": torch.ones(2, 3), "positions": torch.ones(2, 3).double(), "mask": torch.ones(2).bool()}


def entries(folder: Path) -> list[Path]:
    return sorted(folder.glob("*/*.safetensors"))


def share_cached(run: Path) -> float:
    """The share of a run's clips whose latents were in the cache."""
    return json.loads((run / "speed.jsonl").read_text().splitlines()[-1])["latents_found"]


@pytest.mark.parametrize(
    ("number", "adapter"), [("stage1", []), ("stage2-voxel", []), ("stage2-voxel", ["adapter={form: rendered}"])]
)
def test_cached_steps_equal_uncached_ones_to_the_bit(persist, walks, stage1, tmp_path, number, adapter):
    changes = [f"base={stage1}", FEW, *adapter]
    assert persist(*stage(number, walks, tmp_path / "without", *changes)).code == 0
    for name in ("cold", "warm"):
        assert persist(*stage(number, walks, tmp_path / name, *changes, "--cache", tmp_path / "cache")).code == 0
        assert equal_runs(tmp_path / "without", tmp_path / name)
    assert share_cached(tmp_path / "without") == 0
    assert share_cached(tmp_path / "cold") < share_cached(tmp_path / "warm") == 1


@pytest.mark.parametrize("strides", ["[1]", "[1, -2]"])
def test_with_a_framewise_codec_the_latents_of_a_trajectory_serve_all_its_clips(persist, walks, tmp_path, strides):
    alone = [*FRAMEWISE, f"data.strides={strides}"]
    assert persist(*stage("stage1", walks, tmp_path / "without", *alone)).code == 0
    for name in ("cold", "warm"):
        assert persist(*stage("stage1", walks, tmp_path / name, *alone, "--cache", tmp_path / "cache")).code == 0
        assert losses(tmp_path / name) == pytest.approx(losses(tmp_path / "without"), rel=1e-4)
    assert len(entries(tmp_path / "cache")) == 2  # trajectories
    assert share_cached(tmp_path / "warm") == 1


def test_fixed_views_of_clips_are_cached_each_by_itself(persist, walks, tmp_path):
    views = [*FRAMEWISE, "data.clips_per_trajectory=2", "data.crop=0.6", "data.mirror=0.5", "data.color_jitter=0.2"]
    assert persist(*stage("stage1", walks, tmp_path / "without", *views)).code == 0
    for name in ("cold", "warm"):
        assert persist(*stage("stage1", walks, tmp_path / name, *views, "--cache", tmp_path / "cache")).code == 0
        assert equal_runs(tmp_path / "without", tmp_path / name)


def test_views_that_come_only_once_are_not_cached(persist, walks, tmp_path):
    once = [*FRAMEWISE, "data.mirror=0.5", "--cache", tmp_path / "cache"]
    assert "no view of a clip comes twice" in persist(*stage("stage1", walks, tmp_path / "run", *once)).err


def test_a_long_trajectory_is_encoded_in_pieces_to_the_same_latents(walks, tmp_path, monkeypatch):
    backbone = make_backbone("cogvideox", MICRO | {"vae": MICRO["vae"] | {"temporal_compression_ratio": 1}})
    clips = ClipDataset([walks], ClipPlan(frames=9, strides=(1,), context_frames=0, seed=3, image_size=(SIZE, SIZE)))
    latents = []
    for pixels in (1 << 22, 7 * SIZE * SIZE):
        monkeypatch.setattr(sources, "PIXELS_AT_ONCE", pixels)
        tensors = TensorCache(CacheSettings(tmp_path / str(pixels), 1))
        cache = ClipCache(tensors, CacheKeys(latents={}, tokens=None, whole_trajectories=backbone.framewise))
        ClipEncoder(backbone, None, Accelerator(cpu=True), cache).with_latents(CachedClips(clips, cache)[0])
        latents.append(read_tensors(entries(tmp_path / str(pixels))[0])[0]["video"])
    assert len(latents[0]) == 24
    assert torch.equal(*latents)


@pytest.fixture(scope="module")
def costly(tmp_path_factory) -> list[str]:
    """Settings of a memory of features of a small vision transformer."""
    from transformers import Dinov2Config, Dinov2Model

    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("vit")
    sizes = {"hidden_size": 24, "num_hidden_layers": 2, "num_attention_heads": 2, "mlp_ratio": 2}
    Dinov2Model(Dinov2Config(image_size=56, patch_size=14, **sizes)).save_pretrained(folder)
    return ["memory.encoder=dinov2", f"memory.encoder_settings={{weights: {folder}}}", "data.clips_per_trajectory=0"]


def test_each_trajectory_is_encoded_once_and_contexts_that_never_come_again_have_the_same_tokens(
    persist, walks, stage1, tmp_path, costly
):
    changes = [f"base={stage1}", *costly]
    assert persist(*stage("stage2-voxel", walks, tmp_path / "without", *changes)).code == 0
    for name in ("cold", "warm"):
        cached = stage("stage2-voxel", walks, tmp_path / name, *changes, "--cache", tmp_path / "cache")
        assert persist(*cached).code == 0
        assert equal_runs(tmp_path / "without", tmp_path / name)
    names = [sorted(read_tensors(path)[0]) for path in entries(tmp_path / "cache")]
    assert names == [["checksum", "features", "frames"]] * 2  # trajectories; no clip's latents or tokens


def test_with_a_full_cache_only_the_clip_is_encoded_and_not_its_trajectory(persist, walks, tmp_path):
    alone = [*FRAMEWISE, "data.strides=[1, -2]"]
    assert persist(*stage("stage1", walks, tmp_path / "without", *alone)).code == 0
    bound = ["--cache", tmp_path / "cache", "--cache-gigabytes", "0"]
    assert persist(*stage("stage1", walks, tmp_path / "full", *alone, *bound)).code == 0
    assert losses(tmp_path / "full") == pytest.approx(losses(tmp_path / "without"), rel=1e-4)
    assert entries(tmp_path / "cache") == []


@pytest.mark.slow
def test_latents_are_stored_in_the_precision_of_training(walks, stage1, tmp_path):
    changes = [f"base={stage1}", FEW, "training.precision=bf16"]  # a process of its own: accelerate fixes it for one
    assert start_persist(*stage("stage1", walks, tmp_path / "without", *changes)).wait() == 0
    for name in ("cold", "warm"):
        cached = stage("stage1", walks, tmp_path / name, *changes, "--cache", str(tmp_path / "cache"))
        assert start_persist(*cached).wait() == 0
        assert equal_runs(tmp_path / "without", tmp_path / name)
    latents = [read_tensors(path)[0]["video"] for path in entries(tmp_path / "cache")]
    assert {video.dtype for video in latents} == {torch.bfloat16}


def test_a_resumed_run_with_a_cache_equals_an_uninterrupted_one_without(persist, walks, stage1, tmp_path):
    changes = [f"base={stage1}", FEW]
    cache = ["--cache", tmp_path / "cache"]
    assert persist(*stage("stage2-voxel", walks, tmp_path / "whole", *changes)).code == 0
    first = stage("stage2-voxel", walks, tmp_path / "halves", *changes, "training.steps=2", *cache)
    assert persist(*first).code == 0
    assert persist(*stage("stage2-voxel", walks, tmp_path / "halves", "--resume", *changes, *cache)).code == 0
    assert equal_runs(tmp_path / "whole", tmp_path / "halves")


def test_colours_and_origins_of_tokens_are_cached(walks, tmp_path):
    clips = clips_in(walks, tmp_path)
    more = {"colors": torch.tensor([[1, 2, 3], [4, 5, 6]], dtype=torch.uint8), "origins": torch.tensor([1, 2]).byte()}
    clips.cache.put_tokens(clips[5].frames, MemoryTokens(**TOKENS, **more))
    tokens = clips[5].sample.clip.tokens
    assert torch.equal(tokens.colors, more["colors"])
    assert torch.equal(tokens.origins, more["origins"])


def clips_in(walks: Path, folder: Path, **changes: object) -> CachedClips:
    """Clips that look into a cache, whose keys depend on made-up values."""
    plan = {"frames": 9, "strides": (1, 2), "context_frames": 5, "seed": 3, "image_size": (SIZE, SIZE)} | changes
    clips = ClipDataset([walks], ClipPlan(**plan, clips_per_trajectory=2))
    keys = CacheKeys(latents={"encoding": "x"}, tokens={"memory": "y"}, whole_trajectories=False)
    return CachedClips(clips, ClipCache(TensorCache(CacheSettings(folder, 1)), keys))


def test_runs_that_share_a_cache_hash_a_data_file_once(walks, tmp_path, monkeypatch):
    hashed = []
    monkeypatch.setattr(file_hashes, "RACY", -1.0)
    monkeypatch.setattr(store, "file_sha256", lambda path: hashed.append(path) or "0" * 64)
    for _ in range(2):
        clips = clips_in(walks, tmp_path / "other")
        cache = ClipCache.of(TensorCache(CacheSettings(tmp_path / "cache", 1)), clips.cache.keys, None)
        cache.latents(clips.clips.choose(0))
    assert len(hashed) == 1


def test_no_image_of_a_cached_clip_is_read(walks, tmp_path):
    clips = clips_in(walks, tmp_path)
    before = clips[5]
    clip = before.sample.clip
    assert len(clip.observations) == 9
    clips.cache.put_latents(before.frames, ClipLatents(torch.ones(4, 8), torch.zeros(1, 8)))
    clips.cache.put_tokens(before.frames, MemoryTokens(**TOKENS))
    sample = clips[5].sample
    assert len(sample.clip.observations) == 0
    assert sample.context is None
    assert torch.equal(sample.clip.latents.video, torch.ones(4, 8))
    assert torch.equal(sample.clip.latents.image, torch.zeros(1, 8))
    assert torch.equal(sample.clip.tokens.positions, TOKENS["positions"])
    cameras = sample.clip.observations.cameras
    assert torch.equal(cameras.world_from_camera, clip.observations.cameras.world_from_camera)
    assert torch.equal(cameras.intrinsics, clip.observations.cameras.intrinsics)
    assert (sample.clip.interactions, sample.clip.seed) == (clip.interactions, clip.seed)


def test_tokens_of_a_clip_without_context_are_cached_too(walks, tmp_path):
    clips = clips_in(walks, tmp_path, context_frames=0)
    clips.cache.put_tokens(clips[5].frames, MemoryTokens(**TOKENS))
    assert torch.equal(clips[5].sample.clip.tokens.features, TOKENS["features"])


def test_clips_of_other_frames_contexts_or_trajectories_have_other_keys(walks, tmp_path):
    clips, less = clips_in(walks, tmp_path), clips_in(walks, tmp_path, context_frames=2)
    clip_keys = {(str(clip.file.path), clip.frames, clip.context): clips.cache.keys.of_clip(clip)
                 for clip in map(clips.clips.choose, range(60))}  # fmt: skip
    assert len({keys.latents for keys in clip_keys.values()}) == 4
    assert len({keys.tokens for keys in clip_keys.values()}) == 4
    assert len(clip_keys) == 4
    long_context, short_context = (dataset.cache.keys.of_clip(dataset.clips.choose(0)) for dataset in (clips, less))
    assert long_context.latents == short_context.latents
    assert long_context.tokens != short_context.tokens
    assert cache_key({"a": 1}) != cache_key({"a": 2})


def test_another_context_or_other_errors_of_it_are_another_memory_of_the_same_clip(walks, tmp_path):
    clips = clips_in(walks, tmp_path)
    clip = clips.clips.choose(0)
    others = [clip, *(replace(clip, noise_seed=seed) for seed in (1, 2)), replace(clip, context=clip.context[1:])]
    keys = [clips.cache.keys.of_clip(other) for other in others]
    assert len({key.tokens for key in keys}) == len({key.memory for key in keys}) == len(others)
    assert len({key.latents for key in keys}) == 1


def test_each_view_of_a_clip_has_keys_of_its_own(walks, tmp_path):
    clips = clips_in(walks, tmp_path)
    views = [None, View(None, True, (1.0, 1.0, 1.0)), View(None, False, (1.0, 1.0, 1.1))]
    keys = [clips.cache.keys.of_clip(replace(clips.clips.choose(0), view=view)) for view in views]
    for part in ("latents", "tokens", "memory"):
        assert len({getattr(key, part) for key in keys}) == len(views)


def test_the_true_cells_of_another_frame_are_another_memory_of_the_same_clip(walks, tmp_path):
    clips = clips_in(walks, tmp_path)
    clip = replace(clips.clips.choose(0), frames=range(9, 18), true_cells=True)
    befores = ((), (range(1, 10),), (range(17, 8, -1),))
    memories = [clips.cache.keys.of_clip(replace(clip, before=before)).memory for before in befores]
    assert len({*memories}) == 3


def test_an_entry_that_is_written_again_is_counted_once(tmp_path):
    cache = TensorCache(CacheSettings(tmp_path, 1))
    for _ in range(2):
        cache.put("0" * 40, {"a": torch.ones(1000)})
    assert cache.used == entries(tmp_path)[0].stat().st_size


def test_a_full_disk_ends_the_storing_with_one_line(tmp_path, capsys):
    cache = TensorCache(CacheSettings(tmp_path, 1))
    with file_limit(1000):
        for name in ("0", "1"):
            cache.put(name * 40, {"a": torch.ones(10_000)})
    cache.put("2" * 40, {"a": torch.ones(1)})
    assert (entries(tmp_path), capsys.readouterr().out.count("not writable")) == ([], 1)


def test_leftovers_of_killed_writers_are_removed_and_files_of_living_ones_are_not(tmp_path):
    stale, fresh = tmp_path / "aa" / f"{ASIDE}0-x.safetensors", tmp_path / "bb" / f"{ASIDE}1-x.safetensors"
    for path in (stale, fresh):
        path.parent.mkdir()
        path.write_bytes(bytes(1000))
    os.utime(stale, times=(0, stale.stat().st_mtime - STALE - 60))
    cache = TensorCache(CacheSettings(tmp_path, 1))
    assert (stale.exists(), fresh.exists()) == (False, True)
    assert cache.used == 0


def test_a_cache_may_be_unlimited_but_its_limit_must_be_a_number(tmp_path):
    TensorCache(CacheSettings(tmp_path, float("inf"))).put("0" * 40, {"a": torch.ones(10)})
    assert len(entries(tmp_path)) == 1
    with pytest.raises(PersistError, match="--cache-gigabytes is nan"):
        TensorCache(CacheSettings(tmp_path, float("nan")))


def test_what_another_user_left_in_a_shared_folder_ends_nothing(tmp_path, monkeypatch, capsys):
    def unlink(path: Path, missing_ok: bool = False) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    TensorCache(CacheSettings(tmp_path, 1)).put("0" * 40, TOKENS)
    entry = entries(tmp_path)[0]
    entry.write_bytes(entry.read_bytes()[:-1])
    leftover = entry.with_name(f"{ASIDE}0-x.safetensors")
    leftover.touch()
    os.utime(leftover, times=(0, 0))
    monkeypatch.setattr(Path, "unlink", unlink)
    assert TensorCache(CacheSettings(tmp_path, 1)).get("0" * 40) is None
    assert "not removed (Permission denied), made anew each time" in capsys.readouterr().out


def test_a_damaged_entry_is_removed_with_one_line_and_made_anew(persist, walks, codec, tmp_path):
    changes = [f"base={codec}", FEW, "--cache", tmp_path / "cache"]
    assert persist(*stage("stage1", walks, tmp_path / "one", *changes)).code == 0
    whole = {path: path.read_bytes() for path in entries(tmp_path / "cache")}
    short, flipped = list(whole)[:2]
    short.write_bytes(whole[short][:-1])
    flipped.write_bytes(whole[flipped][:-1] + bytes([whole[flipped][-1] ^ 1]))
    run = persist(*stage("stage1", walks, tmp_path / "two", *changes))
    assert run.code == 0
    assert run.out.count("removed, made anew") == 2
    assert equal_runs(tmp_path / "one", tmp_path / "two")
    assert {path: path.read_bytes() for path in entries(tmp_path / "cache")} == whole


def test_a_full_cache_says_so_once_and_the_run_goes_on(persist, walks, codec, tmp_path):
    changes = [f"base={codec}", "data.clips_per_trajectory=30"]
    bound = ["--cache", tmp_path / "cache", "--cache-gigabytes", "1e-5"]
    assert persist(*stage("stage1", walks, tmp_path / "one", *changes)).code == 0
    run = persist(*stage("stage1", walks, tmp_path / "two", *changes, *bound))
    assert (run.code, run.out.count("what is not in it is made anew each time")) == (0, 1)
    assert equal_runs(tmp_path / "one", tmp_path / "two")
    sizes = [path.stat().st_size for path in entries(tmp_path / "cache")]
    assert 0 < sum(sizes) <= 1e4


def test_two_writers_keep_to_one_limit(tmp_path):
    writers = [TensorCache(CacheSettings(tmp_path, 1e-4)) for _ in range(2)]
    for number in range(60):
        writers[number % 2].put(f"{number:040}", {"a": torch.ones(1000)})
    assert 0.9e5 < sum(path.stat().st_size for path in entries(tmp_path)) <= 1e5


def test_each_use_of_a_cache_that_is_impossible_ends_in_one_line(persist, walks, codec, tmp_path):
    (tmp_path / "file").write_text("")
    cache = ["--cache", tmp_path / "cache"]
    for arguments, cause in (
        (stage("stage1", walks, tmp_path / "a", f"base={codec}", *cache), "clips_per_trajectory=0"),
        (
            stage("codec", walks, tmp_path / "a", FEW, *MICRO_SETTINGS, *cache),
            "stage codec backbone 'cogvideox' keeps nothing",
        ),
        (stage("stage1", walks, tmp_path / "a", f"base={codec}", FEW, "--cache", tmp_path / "file"), "no folder"),
        (stage("stage1", walks, tmp_path / "a", f"base={codec}", "--cache-gigabytes", 3), "give --cache DIR too"),
    ):
        run = persist(*arguments)
        assert run.code == 1
        assert cause in run.err
        assert len(run.err.strip().splitlines()) == 1
