"""Training on own writes: chained samples begin with what the model predicted, and runs stay reproducible."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from accelerate import Accelerator
from safetensors.torch import load_file

from persist_cli.api.backbone import Clips
from persist_cli.api.cameras import check_poses
from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.api.geometry import pose_differences
from persist_cli.api.observations import Observations, Origin
from persist_cli.checkpoints.load import adapter_memory, load_backbone
from persist_cli.data.clips import ClipDataset, ClipPlan
from persist_cli.data.store import Store
from persist_cli.data.writing_noise import NO_ERRORS, WritingNoise
from persist_cli.errors import DataError, RecipeError
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.recipe import MemoryConfig, make_recipe
from persist_cli.train.clip_cache import CachedClips, ClipEncoder
from persist_cli.train.own_writes import OwnWrites
from tests.support.micro_model import FRAMEWISE, micro, with_adapter
from tests.support.micro_runs import SIZE, equal_runs, losses, stage

OWN = ["data.own_writes=0.7", "data.own_warmup=1", "data.strides=[1]"]


def chained_clips(walks, **changes) -> ClipDataset:
    plan = {"own_writes": 1.0, "strides": (1, -1), "context_frames": 5} | changes
    return ClipDataset([walks], ClipPlan(frames=9, seed=3, image_size=(SIZE, SIZE), **plan))


def test_the_segments_of_a_chained_sample_follow_each_other_and_its_context_comes_before_all(walks):
    clips = chained_clips(walks)
    for choice in (clips.choose(number) for number in range(20)):
        assert len(choice.before) == 1
        assert choice.before[0][-1] == choice.frames[0]
        assert choice.before[0].step == choice.frames.step
        assert choice.context[-1] == choice.before[0][0]


def test_segments_of_a_sample_are_predicted_from_other_noise_than_its_clip(walks):
    for choice in map(chained_clips(walks, segments=2).choose, range(20)):
        before, clip = choice.segments()
        assert clip.seed == choice.seed != before.seed


def test_a_share_of_the_samples_is_chained_after_the_warm_up(walks):
    clips = chained_clips(walks, own_writes=0.5, own_after=100)
    chained = [bool(clips.choose(number).before) for number in range(300)]
    assert not any(chained[:100])
    assert 60 < sum(chained) < 140


def test_without_own_writes_the_samples_are_those_of_before(walks):
    plain, later = chained_clips(walks, own_writes=0.0), chained_clips(walks, own_writes=0.0, own_after=9, segments=4)
    assert [plain.choose(number).frames for number in range(9)] == [later.choose(number).frames for number in range(9)]


def test_a_data_set_of_short_walks_is_refused_with_the_frames_that_are_needed(walks):
    with pytest.raises(DataError, match="4 segments of a clip need 33 frames, the longest trajectory has 24; set"):
        chained_clips(walks, segments=4)


@pytest.fixture(scope="module")
def encoder(voxel):
    """Encoder, memories and model of a trained stage-2 run."""
    checkpoint = find_checkpoint(voxel)
    factory = MemoryFactory.of(adapter_memory(checkpoint, "voxel"))
    return ClipEncoder(load_backbone(checkpoint, adapter="voxel"), factory, Accelerator(cpu=True), None)


def test_a_clip_begins_with_the_frame_that_the_model_predicted_and_remembers_what_it_wrote(walks, encoder):
    cached = encoder.with_latents(CachedClips(chained_clips(walks), None)[0])
    (own,) = OwnWrites(encoder, NO_ERRORS).written([cached])
    before, after = cached.sample.clip.latents, own.sample.clip.latents
    assert torch.equal(before.video, after.video)  # the target is true
    assert not torch.equal(before.image, after.image)
    origins = own.sample.remembered["origins"].tolist()
    assert {Origin.IMAGINED, Origin.OBSERVED} == set(origins)
    assert encoder.with_tokens(own).tokens.origins.min() == Origin.IMAGINED


class Written(list):
    """Errors of what is written, which leave it as it is and keep it."""

    def disturb(self, seen, draws):
        self.append((seen, torch.rand(1, generator=draws)))
        return seen


def numbered(clips: Clips) -> tuple[torch.Tensor, torch.Tensor]:
    """Predictions whose colours and metres are the numbers of their frames."""
    numbers = torch.arange(9).view(1, 9, 1, 1).expand(len(clips.seeds), 9, SIZE, SIZE)
    return numbers[..., None].expand(-1, -1, -1, -1, 3).to(torch.uint8), numbers.float()


def test_predicted_frames_are_written_where_the_cameras_of_their_segment_saw_them(walks, encoder, monkeypatch):
    clips, written = CachedClips(chained_clips(walks), None), Written()
    samples = [encoder.with_latents(clips[number]) for number in (0, 1)]
    monkeypatch.setattr(encoder.backbone, "predict_once", numbered)
    owns = OwnWrites(encoder, written).written(samples)
    for cached, own, (seen, draw) in zip(samples, owns, written, strict=True):
        noise = torch.Generator().manual_seed(cached.sample.clip.seed)
        assert not torch.equal(draw, torch.rand(1, generator=noise))  # errors are no numbers of the clip's noise
        cameras = cached.sample.before[0].observations.cameras
        assert torch.equal(seen.cameras.world_from_camera, cameras.world_from_camera[1:])
        assert seen.rgb[:, 0, 0, 0].tolist() == seen.depth[:, 0, 0].tolist() == list(range(1, 9))
        assert set(seen.origins.tolist()) == {Origin.IMAGINED}
        last = replace(cached.sample.clip, observations=seen[-1:], latents=None)
        assert torch.equal(own.sample.clip.latents.image, encoder.encode(last).image)
    assert written[0][1] != written[1][1]  # each sample has errors of its own


def test_a_memory_imagines_what_each_segment_and_the_clip_will_see_before_it_is_read(walks, encoder, monkeypatch):
    cached, kind, told = encoder.with_latents(CachedClips(chained_clips(walks), None)[0]), encoder.factory.kind, []
    recall = kind.recall

    def recorded(memory, paths, *more):
        told.append(("read", paths[0]))
        return recall(memory, paths, *more)

    monkeypatch.setattr(kind, "foresee", lambda memory, paths: told.append(("imagined", paths[0])))
    monkeypatch.setattr(kind, "recall", recorded)
    (own,) = OwnWrites(encoder, NO_ERRORS).written([cached])
    encoder.with_tokens(own)
    assert [what for what, _ in told] == ["imagined", "read"] * 2
    for (_, path), clip in zip(told, [*cached.sample.before * 2, *[cached.sample.clip] * 2], strict=True):
        assert torch.equal(path.world_from_camera, clip.observations.cameras.world_from_camera)


def test_each_segment_begins_with_the_frame_that_was_predicted_last_and_has_errors_of_its_own(walks, monkeypatch):
    factory = MemoryFactory.of(MemoryConfig("voxel"))
    encoder = ClipEncoder(with_adapter(micro(**FRAMEWISE)), factory, Accelerator(cpu=True), None)
    plan = replace(chained_clips(walks, strides=(1,)).plan, frames=5, segments=3)
    cached = encoder.with_latents(CachedClips(ClipDataset([walks], plan), None)[0])
    given, ends, written = list[Clips](), (60, 190), Written()

    def predict(clips: Clips) -> tuple[torch.Tensor, torch.Tensor]:
        grey = ends[len(given)]
        given.append(clips)
        return torch.full((1, 5, SIZE, SIZE, 3), grey, dtype=torch.uint8), torch.full((1, 5, SIZE, SIZE), grey / 50)

    monkeypatch.setattr(encoder.backbone, "predict_once", predict)
    (own,) = OwnWrites(encoder, written).written([cached])
    first, second = cached.sample.before
    assert len({draw.item() for _, draw in written}) == 2
    assert torch.equal(given[0].latents.image[0], first.latents.image)  # true: nothing was predicted before
    for clip, latents, grey in ((second, given[1].latents[0], 60), (cached.sample.clip, own.sample.clip.latents, 190)):
        rgb, depth = torch.full((1, SIZE, SIZE, 3), grey, dtype=torch.uint8), torch.full((1, SIZE, SIZE), grey / 50)
        seen = replace(clip, observations=Observations(rgb, depth, clip.observations.cameras[:1]), latents=None)
        assert torch.equal(latents.image, encoder.encode(seen).image)
        assert torch.equal(latents.video, clip.latents.video)
    assert [seeds for clips in given for seeds in clips.seeds] == [first.seed, second.seed]


def test_other_samples_of_a_batch_are_left_alone(walks, encoder):
    plain = encoder.with_latents(CachedClips(chained_clips(walks, own_writes=0.0), None)[4])
    chained = encoder.with_latents(CachedClips(chained_clips(walks), None)[4])
    alone = OwnWrites(encoder, NO_ERRORS).written([chained])
    both = OwnWrites(encoder, NO_ERRORS).written([plain, chained])
    assert both[0] is plain
    assert torch.allclose(both[1].sample.clip.latents.image, alone[0].sample.clip.latents.image, atol=1e-4)


@torch.no_grad()
def test_a_prediction_from_hardly_any_noise_is_what_the_codec_makes_of_the_clip(walks, encoder):
    backbone, clip = encoder.backbone, CachedClips(chained_clips(walks), None)[4].sample.clip
    weakest = next(seed for seed in range(10_000) if torch.randint(0, 1000, (1,), generator=seeded(seed)) < 2)
    clips = Clips.stack([replace(clip, seed=weakest)])
    (rgb, depth), (same, metres) = backbone.predict_once(clips), backbone.reconstruct(clips)
    assert (rgb.float() - same.float()).abs().mean() < 3
    assert ((depth - metres).abs() / metres).mean() < 0.03


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("number", ["stage1", "stage2-voxel"])
def test_a_run_on_own_writes_resumed_with_a_cache_equals_an_uninterrupted_one_without(
    persist, walks, stage1, tmp_path, number
):
    changes = [f"base={stage1}", "data.clips_per_trajectory=3", *OWN]
    changes += ["data.pose_drift=0.01", "data.depth_noise=0.02"] if number == "stage2-voxel" else []
    cache = ["--cache", tmp_path / "cache"]
    assert persist(*stage(number, walks, tmp_path / "whole", *changes)).code == 0
    assert persist(*stage(number, walks, tmp_path / "halves", *changes, "training.steps=2", *cache)).code == 0
    assert persist(*stage(number, walks, tmp_path / "halves", "--resume", *changes, *cache)).code == 0
    assert equal_runs(tmp_path / "whole", tmp_path / "halves")
    assert persist(*stage(number, walks, tmp_path / "true", *changes, "data.own_writes=0.001")).code == 0
    assert losses(tmp_path / "whole")[0] == losses(tmp_path / "true")[0]  # the warm-up
    assert losses(tmp_path / "whole")[1:] != losses(tmp_path / "true")[1:]


def test_an_adapter_learns_from_own_writes_what_was_imagined(persist, walks, stage1, tmp_path):
    learned = {}
    for name, changes in {"own": OWN, "true": []}.items():
        changes = [f"base={stage1}", "adapter.origins=true", *changes]
        assert persist(*stage("stage2-voxel", walks, tmp_path / name, *changes)).code == 0
        weights = find_checkpoint(tmp_path / name).adapters["voxel"] / "adapter.safetensors"
        learned[name] = bool(load_file(weights)["origin.imagined"].any())
    assert learned == {"own": True, "true": False}


def test_own_writes_are_refused_where_nothing_is_predicted():
    values = {"stage": "codec", "data": {"own_writes": 0.5}}
    with pytest.raises(RecipeError, match=r"^mine: data.own_writes is for stages 1 and 2; leave it out$"):
        make_recipe(values, "mine")


def test_poses_drift_from_the_last_frame_backwards(walks):
    seen = next(iter(Store(walks))).read().observations
    pairs = []
    for seed in range(40):
        drifted = WritingNoise(metres=0.01).disturb(seen, seeded(seed))
        pairs.append(pose_differences(seen.cameras.world_from_camera, drifted.cameras.world_from_camera)[0])
    errors = torch.stack(pairs).square().mean(0).sqrt()
    assert errors[-1] == 0
    assert errors[-2].item() == pytest.approx(0.01 * 3**0.5, rel=0.3)
    assert errors[0].item() == pytest.approx(0.01 * (3 * 23) ** 0.5, rel=0.3)


def test_neighbours_agree_however_far_they_drifted_and_the_agent_turned(walks):
    seen = next(iter(Store(walks))).read().observations
    turning = torch.eye(4).repeat(24, 1, 1)
    turning[:, 0, 0] = turning[:, 2, 2] = torch.cos(torch.arange(24) * 0.5)
    turning[:, 0, 2] = torch.sin(torch.arange(24) * 0.5)
    turning[:, 2, 0] = -turning[:, 0, 2]
    turning[:, 0, 3] = torch.arange(24) * 0.2
    cameras = replace(seen.cameras, world_from_camera=turning)
    drifted = WritingNoise(metres=0.01, degrees=1.0).disturb(replace(seen, cameras=cameras), seeded(3))
    poses = drifted.cameras.world_from_camera
    check_poses(poses, "drifted")
    motions, true = poses[1:].inverse() @ poses[:-1], turning[1:].inverse() @ turning[:-1]
    metres, degrees = pose_differences(motions, true)
    assert 0.01 < metres.square().mean().sqrt() < 0.025
    assert 1.0 < degrees.square().mean().sqrt() < 2.5


def test_errors_of_depth_are_a_share_of_it_and_missing_depth_stays_missing(walks):
    seen = next(iter(Store(walks))).read().observations
    seen.depth[:, :4] = 0
    wrong = WritingNoise(depth=0.05).disturb(seen, seeded(1))
    assert not wrong.depth[:, :4].any()
    share = (wrong.depth / seen.depth)[:, 4:] - 1
    assert 0.02 < share.std() < 0.06
    assert torch.equal(wrong.depth, WritingNoise(depth=0.05).disturb(seen, seeded(1)).depth)
    assert WritingNoise().disturb(seen, seeded(1)) is seen
