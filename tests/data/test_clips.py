"""tests.data.test_clips."""

from __future__ import annotations

import shutil

import pytest
import torch

from persist_cli.data.clips import ClipDataset, ClipPlan, DistributedBatches
from persist_cli.errors import DataError, RecipeError
from tests.support.walking import SIZE


def plan(**changes) -> ClipPlan:
    return ClipPlan(
        **{"frames": 9, "strides": (1, 2), "context_frames": 5, "seed": 3, "image_size": (SIZE, SIZE)} | changes
    )


def test_sample_n_is_the_same_whoever_asks(walks):
    one, two = ClipDataset([walks], plan())[11], ClipDataset([walks], plan())[11]
    assert torch.equal(one.observations.rgb, two.observations.rgb)
    assert torch.equal(one.context.depth, two.context.depth)
    assert one.seed == two.seed
    assert one.seed != ClipDataset([walks], plan(seed=4))[11].seed


def test_several_data_sets_are_one_after_the_other(walks, tmp_path):
    for number in (0, 1):
        (tmp_path / str(number)).mkdir()
        shutil.copy(walks / f"walk-{number}.parquet", tmp_path / str(number))
    one, two = ClipDataset([walks], plan()), ClipDataset([tmp_path / "0", tmp_path / "1"], plan())
    for number in range(20):
        assert torch.equal(one[number].observations.rgb, two[number].observations.rgb)


def test_the_context_ends_with_the_clips_first_frame_and_holds_no_later_one(walks):
    clips = ClipDataset([walks], plan())
    for number in range(20):
        sample = clips[number]
        assert 1 <= len(sample.context) <= 5
        assert torch.equal(sample.context.rgb[-1], sample.observations.rgb[0])


def test_interactions_of_skipped_frames_are_kept(walks):
    clips = ClipDataset([walks], plan(strides=(2,)))
    found = [clips[number].interactions for number in range(40)]
    assert any("pick_up" in each for each in found)
    assert all(len(each) == 8 for each in found)


def test_a_negative_stride_plays_backwards_with_what_was_seen_on_the_way_there(walks):
    clips = ClipDataset([walks], plan(strides=(-2,), context_frames=100))
    for number in range(10):
        choice, sample = clips.choose(number), clips[number]
        assert choice.frames.step == -2
        assert set(choice.frames) <= set(choice.context)
        assert sample.interactions == (None,) * 8
        forth = choice.file.read(sorted(choice.frames)).observations
        assert torch.equal(sample.observations.rgb, forth.rgb.flip(0))
        assert torch.equal(sample.observations.cameras.centers, forth.cameras.centers.flip(0))


def test_few_clips_a_trajectory_come_again_with_their_context_and_with_new_noise(walks):
    clips = ClipDataset([walks], plan(clips_per_trajectory=2))
    drawn = [clips.choose(number) for number in range(60)]
    assert len({(str(each.file.path), each.frames, each.context) for each in drawn}) == 2 * len(clips.files)
    assert len({each.seed for each in drawn}) == 60


def test_the_few_clips_are_the_same_with_and_without_context(walks):
    one, two = (ClipDataset([walks], plan(clips_per_trajectory=5, context_frames=frames)) for frames in (0, 5))
    for number in range(20):
        assert one.choose(number).frames == two.choose(number).frames


@pytest.mark.parametrize(("processes", "accumulation"), [(1, 1), (2, 1), (1, 4), (2, 2)])
def test_processes_and_micro_batches_share_the_same_samples_of_each_step(processes, accumulation):
    parts = [list(DistributedBatches(3, 5, 8, accumulation, each, processes)) for each in range(processes)]
    for step in (0, 1):
        of_step = slice(step * accumulation, (step + 1) * accumulation)
        numbers = sorted(number for part in parts for batch in part[of_step] for number in batch)
        assert numbers == list(range((3 + step) * 8, (4 + step) * 8))


def test_a_run_that_changes_its_number_of_processes_reads_every_clip_once_and_in_order():
    read = []
    for first, processes in ((0, 2), (2, 1), (4, 4)):  # two steps by so many
        parts = [DistributedBatches(first, first + 2, 8, 2, each, processes) for each in range(processes)]
        read += [number for micro in zip(*parts, strict=True) for batch in micro for number in batch]
    assert read == [number for batch in DistributedBatches(0, 6, 8, 1, 0, 1) for number in batch]


def test_what_cannot_be_drawn_is_one_line(walks):
    with pytest.raises(DataError, match="a clip needs 65 frames, the longest trajectory has 24"):
        ClipDataset([walks], plan(frames=65))
    with pytest.raises(DataError, match="images are 32x32, the model takes 64x64"):
        ClipDataset([walks], plan(image_size=(64, 64)))
    with pytest.raises(RecipeError, match=r"cannot be shared by 3 processes .* give training.batch=6 training.acc"):
        DistributedBatches(0, 1, 8, 1, 0, 3)
