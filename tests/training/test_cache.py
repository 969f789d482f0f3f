import json
from pathlib import Path

import pytest
import torch

from persist_cli.training.cache import Cache, CachePlace, name_of
from persist_cli.training.keeping import Dependencies, KeptClips
from persist_cli.trajectories.clips import ClipDataset, ClipPlan
from persist_cli.world.files import read_tensors
from tests.walking import MICRO_SETTINGS, SIZE, stage, together, train

FEW = "data.clips_per_trajectory=3"


def entries(folder: Path) -> list[Path]:
    return sorted(folder.glob("*/*.safetensors"))


def ended(run: Path) -> tuple[dict[str, torch.Tensor], str]:
    """Everything that a run came to: its newest training state and its log."""
    return read_tensors(max(run.glob("step-*")) / "training.safetensors")[0], (run / "log.jsonl").read_text()


def same(one: Path, two: Path) -> bool:
    (weights, log), (others, other_log) = ended(one), ended(two)
    return log == other_log and all(torch.equal(weights[name], others[name]) for name in weights | others)


def found(run: Path) -> float:
    """Share of a run's clips that came with latents."""
    return json.loads((run / "speed.jsonl").read_text().splitlines()[-1])["latents_found"]


@pytest.mark.parametrize("number", ["stage1", "stage2-voxel"])
def test_cached_steps_equal_uncached_ones_to_the_bit(persist, walks, stage1, tmp_path, number):
    changes = [f"base={stage1}", FEW]
    assert persist(*stage(number, walks, tmp_path / "without", *changes)).code == 0
    for name in ("cold", "warm"):
        assert persist(*stage(number, walks, tmp_path / name, *changes, "--cache", tmp_path / "cache")).code == 0
        assert same(tmp_path / "without", tmp_path / name)
    assert found(tmp_path / "without") == 0
    assert found(tmp_path / "cold") < found(tmp_path / "warm") == 1


STILL = "backbone.settings.vae={block_out_channels: [8, 8, 8], norm_num_groups: 4, latent_channels: 4, "
ALONE = ["base=null", *MICRO_SETTINGS, STILL + "temporal_compression_ratio: 1}"]


def test_where_frames_are_coded_alone_the_latents_of_a_trajectory_serve_all_its_clips(persist, walks, tmp_path):
    cache = ["--cache", tmp_path / "cache"]
    assert persist(*stage("stage1", walks, tmp_path / "without", *ALONE, "data.strides=[1]")).code == 0
    assert persist(*stage("stage1", walks, tmp_path / "cold", *ALONE, "data.strides=[1]", *cache)).code == 0
    assert persist(*stage("stage1", walks, tmp_path / "other", *ALONE, "data.strides=[2]", *cache)).code == 0
    assert len(entries(tmp_path / "cache")) == 2  # trajectories
    assert found(tmp_path / "other") == 1
    logs = [(tmp_path / run / "log.jsonl").read_text().splitlines() for run in ("without", "cold")]
    for one, two in zip(*logs, strict=True):
        assert json.loads(one)["loss"] == pytest.approx(json.loads(two)["loss"], rel=1e-4)


@pytest.mark.slow
def test_latents_are_kept_in_the_precision_of_training(walks, stage1, tmp_path):
    changes = [f"base={stage1}", FEW, "training.precision=bf16"]  # a process of its own: accelerate fixes it for one
    train(*stage("stage1", walks, tmp_path / "without", *changes))
    for name in ("cold", "warm"):
        train(*stage("stage1", walks, tmp_path / name, *changes, "--cache", str(tmp_path / "cache")))
        assert same(tmp_path / "without", tmp_path / name)
    kept = [read_tensors(path)[0]["latents"] for path in entries(tmp_path / "cache")]
    assert {latents.dtype for latents in kept} == {torch.bfloat16}


def test_a_resumed_run_with_a_cache_equals_an_uninterrupted_one_without(persist, walks, stage1, tmp_path):
    changes = [f"base={stage1}", FEW]
    cache = ["--cache", tmp_path / "cache"]
    assert persist(*stage("stage2-voxel", walks, tmp_path / "whole", *changes)).code == 0
    first = stage("stage2-voxel", walks, tmp_path / "halves", *changes, "training.steps=2", *cache)
    assert persist(*first).code == 0
    assert persist(*stage("stage2-voxel", walks, tmp_path / "halves", "--resume", *changes, *cache)).code == 0
    assert same(tmp_path / "whole", tmp_path / "halves")


def test_stages_and_memories_share_latents_and_nothing_that_depends_on_more(persist, walks, codec, stage1, tmp_path):
    cache = ["--cache", tmp_path / "cache", FEW]
    assert persist(*stage("stage1", walks, tmp_path / "one", f"base={codec}", *cache)).code == 0
    latents = len(entries(tmp_path / "cache"))
    for number, (name, change) in enumerate(
        [("voxel", "memory.settings={}"), ("voxel", "memory.settings={cell: [0.5, 0.5, 0.5]}"),
         ("voxel", "adapter.token_budget=7"), ("map2d", "memory.settings={}")]
    ):  # fmt: skip
        run = tmp_path / f"two-{number}"
        assert persist(*stage(f"stage2-{name}", walks, run, f"base={stage1}", change, *cache)).code == 0
        assert found(run) == 1
        assert len(entries(tmp_path / "cache")) == latents * (number + 2)


def clip_cache(walks: Path, folder: Path, **changes: object) -> KeptClips:
    """Clips that look into a cache, with made-up dependencies."""
    plan = {"frames": 9, "strides": (1, 2), "context_frames": 5, "seed": 3, "image_size": (SIZE, SIZE)} | changes
    clips = ClipDataset(walks, ClipPlan(**plan, clips_per_trajectory=2))
    return KeptClips(clips, Cache(CachePlace(folder, 1)), Dependencies({"encoding": "x"}, {"memory": "y"}))


def test_a_known_clip_is_given_without_reading_an_image(walks, tmp_path):
    clips = clip_cache(walks, tmp_path)
    before = clips[5]
    assert len(before.observations) == 9
    clips.cache.put(before.keys[0], {"latents": torch.ones(4, 8)})
    tokens = {"features": torch.ones(2, 3), "positions": torch.ones(2, 3).double(), "mask": torch.ones(2).bool()}
    clips.cache.put(before.keys[1], tokens)
    after = clips[5]
    assert len(after.observations) == 0
    assert after.context is None
    assert torch.equal(after.latents, torch.ones(4, 8))
    assert torch.equal(after.tokens.positions, tokens["positions"])
    cameras = before.observations.cameras
    assert torch.equal(after.observations.cameras.world_from_camera, cameras.world_from_camera)
    assert torch.equal(after.observations.cameras.intrinsics, cameras.intrinsics)
    assert (after.interactions, after.seed) == (before.interactions, before.seed)


def test_other_frames_contexts_or_trajectories_have_other_names(walks, tmp_path):
    clips = clip_cache(walks, tmp_path)
    seen = {(str(choice.file.path), choice.frames, choice.context): clips.keys(choice)
            for choice in map(clips.clips.choose, range(60))}  # fmt: skip
    assert len({keys[0] for keys in seen.values()}) == len({keys[1] for keys in seen.values()}) == len(seen) == 4
    less = clip_cache(walks, tmp_path, context_frames=2)
    one, two = clips.keys(clips.clips.choose(0)), less.keys(less.clips.choose(0))
    assert one[0] == two[0]
    assert one[1] != two[1]
    assert name_of({"a": 1}) != name_of({"a": 2})


def test_a_damaged_entry_is_thrown_away_with_one_line_and_made_anew(persist, walks, codec, tmp_path):
    changes = [f"base={codec}", FEW, "--cache", tmp_path / "cache"]
    assert persist(*stage("stage1", walks, tmp_path / "one", *changes)).code == 0
    whole = {path: path.read_bytes() for path in entries(tmp_path / "cache")}
    short, flipped = list(whole)[:2]
    short.write_bytes(whole[short][:-1])
    flipped.write_bytes(whole[flipped][:-1] + bytes([whole[flipped][-1] ^ 1]))
    run = persist(*stage("stage1", walks, tmp_path / "two", *changes))
    assert run.code == 0
    assert run.out.count("removed, made anew") == 2
    assert same(tmp_path / "one", tmp_path / "two")
    assert {path: path.read_bytes() for path in entries(tmp_path / "cache")} == whole


def test_a_full_cache_says_so_once_and_the_run_goes_on(persist, walks, codec, tmp_path):
    changes = [f"base={codec}", "data.clips_per_trajectory=30"]
    bound = ["--cache", tmp_path / "cache", "--cache-gigabytes", "1e-5"]
    assert persist(*stage("stage1", walks, tmp_path / "one", *changes)).code == 0
    run = persist(*stage("stage1", walks, tmp_path / "two", *changes, *bound))
    assert (run.code, run.out.count("what is not in it is made anew each time")) == (0, 1)
    assert same(tmp_path / "one", tmp_path / "two")
    sizes = [path.stat().st_size for path in entries(tmp_path / "cache")]
    assert 0 < sum(sizes) <= 1e4


def test_what_cannot_be_cached_is_one_line(persist, walks, codec, tmp_path):
    (tmp_path / "file").write_text("")
    cache = ["--cache", tmp_path / "cache"]
    for arguments, cause in (
        (stage("stage1", walks, tmp_path / "a", f"base={codec}", *cache), "clips_per_trajectory=0"),
        (stage("codec", walks, tmp_path / "a", FEW, *cache), "stage codec trains the codec"),
        (stage("stage1", walks, tmp_path / "a", f"base={codec}", FEW, "--cache", tmp_path / "file"), "no folder"),
    ):
        run = persist(*arguments)
        assert run.code == 1
        assert cause in run.err
        assert len(run.err.strip().splitlines()) == 1


@pytest.mark.slow
def test_two_processes_share_a_cache(walks, stage1, tmp_path):
    changes = [f"base={stage1}", "training.batch=4", FEW]
    together(*stage("stage2-voxel", walks, tmp_path / "without", *changes))
    for name in ("cold", "warm"):
        together(*stage("stage2-voxel", walks, tmp_path / name, *changes, "--cache", str(tmp_path / "cache")))
        assert same(tmp_path / "without", tmp_path / name)
    assert found(tmp_path / "warm") == 1
    train(*stage("stage2-voxel", walks, tmp_path / "one", *changes, "--cache", str(tmp_path / "cache")))
    assert found(tmp_path / "one") == 1
