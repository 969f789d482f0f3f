"""A clip depends on the seed and its number only, and processes share the samples of a step."""

from __future__ import annotations

import re
import shutil

import pytest
import torch

from persist_cli.api.geometry import near_poses
from persist_cli.data.clips import ClipDataset, ClipPlan, DistributedBatches
from persist_cli.data.writing_noise import WritingNoise
from persist_cli.errors import DataError, RecipeError
from tests.support.cell_walks import CHANGE, cells_around, write_with_cells
from tests.support.micro_runs import SIZE


def plan(**changes) -> ClipPlan:
    return ClipPlan(
        **{"frames": 9, "strides": (1, 2), "context_frames": 5, "seed": 3, "image_size": (SIZE, SIZE)} | changes
    )


def test_sample_n_depends_on_the_seed_and_n_only(walks):
    first, second = ClipDataset([walks], plan())[11], ClipDataset([walks], plan())[11]
    assert torch.equal(first.clip.observations.rgb, second.clip.observations.rgb)
    assert torch.equal(first.context.depth, second.context.depth)
    assert first.clip.seed == second.clip.seed
    assert first.clip.seed != ClipDataset([walks], plan(seed=4))[11].clip.seed


def test_several_data_sets_are_read_as_one_in_their_order(walks, tmp_path):
    for number in (0, 1):
        (tmp_path / str(number)).mkdir()
        shutil.copy(walks / f"walk-{number}.parquet", tmp_path / str(number))
    whole, parts = ClipDataset([walks], plan()), ClipDataset([tmp_path / "0", tmp_path / "1"], plan())
    for number in range(20):
        assert torch.equal(whole[number].clip.observations.rgb, parts[number].clip.observations.rgb)


def test_the_context_ends_with_the_clips_first_frame_and_holds_no_later_one(walks):
    clips = ClipDataset([walks], plan())
    for number in range(20):
        sample = clips[number]
        assert 1 <= len(sample.context) <= 5
        assert torch.equal(sample.context.rgb[-1], sample.clip.observations.rgb[0])


def test_interactions_of_skipped_frames_are_kept(walks):
    clips = ClipDataset([walks], plan(strides=(2,)))
    interactions = [clips[number].clip.interactions for number in range(40)]
    assert any("pick_up" in names for names in interactions)
    assert all(len(names) == 8 for names in interactions)


@pytest.mark.parametrize("stride", [1, 2])
def test_an_interaction_stands_at_the_step_in_which_it_was_done(walks, stride):
    clips = ClipDataset([walks], plan(strides=(stride,)))
    samples = [(clips.choose(number), clips[number].clip.interactions) for number in range(20)]
    places = set()
    for choice, interactions in samples:
        done = choice.file.actions().index("pick_up") - choice.frames[0]
        place = done // stride if 0 <= done < 8 * stride else None
        assert interactions == tuple("pick_up" if step == place else None for step in range(8))
        places.add(place)
    assert len(places) > 2


def test_a_negative_stride_plays_backwards_and_its_context_holds_the_frames_of_the_way_there(walks):
    clips = ClipDataset([walks], plan(strides=(-2,), context_frames=100))
    for number in range(10):
        choice, sample = clips.choose(number), clips[number]
        assert choice.frames.step == -2
        assert set(choice.frames) <= set(choice.context)
        assert sample.clip.interactions == (None,) * 8
        forth = choice.file.read(sorted(choice.frames)).observations
        assert torch.equal(sample.clip.observations.rgb, forth.rgb.flip(0))
        assert torch.equal(sample.clip.observations.cameras.centers, forth.cameras.centers.flip(0))


def test_a_context_without_targets_holds_no_frame_near_a_frame_to_predict_but_the_first(walks):
    clips = ClipDataset([walks], plan(strides=(1, -1), context_frames=100, exclude_targets=1.0))
    for choice in (clips.choose(number) for number in range(20)):
        poses = choice.file.poses()
        near = near_poses(poses[list(choice.context)], poses[list(choice.frames[1:])])
        assert choice.context[-1] == choice.frames[0]
        assert not near[:-1].any()


def test_what_is_near_a_frame_to_predict_is_what_the_plan_says(walks):
    def contexts(**near):
        clips = ClipDataset([walks], plan(context_frames=100, exclude_targets=1.0, **near))
        return sum(len(clips.choose(number).context) for number in range(20))

    assert contexts(exclude_metres=100.0, exclude_degrees=181.0) == 20  # the first frames of the clips alone
    for name in ("exclude_metres", "exclude_degrees"):
        assert contexts(**{name: 100.0}) < contexts()


@pytest.mark.parametrize("stride", [2, -2])
def test_clips_begin_and_end_at_every_frame_that_they_can(walks, stride):
    clips = ClipDataset([walks], plan(strides=(stride,)))
    choices = [clips.choose(number) for number in range(300)]
    assert {min(choice.frames) for choice in choices} == set(range(24 - 16))
    assert {max(choice.frames) for choice in choices} == set(range(16, 24))


def test_most_clips_go_without_their_targets_and_the_others_keep_them(walks):
    clips = ClipDataset([walks], plan(strides=(-1,), context_frames=100, exclude_targets=0.9))
    choices = [clips.choose(number) for number in range(300)]
    kept = sum(set(choice.frames) <= set(choice.context) for choice in choices)
    assert 15 <= kept <= 45


def test_fixed_clips_come_again_with_their_context_and_with_new_noise(walks):
    clips = ClipDataset([walks], plan(clips_per_trajectory=2))
    choices = [clips.choose(number) for number in range(60)]
    assert len({(str(choice.file.path), choice.frames, choice.context) for choice in choices}) == 2 * len(clips.files)
    assert len({choice.seed for choice in choices}) == 60


def test_each_context_has_errors_of_its_own_which_come_again_with_it(walks):
    clips = ClipDataset([walks], plan(clips_per_trajectory=3, context_frames=2, noise=WritingNoise(depth=0.05)))
    errors: dict[object, list[float]] = {}
    for number in range(60):
        choice = clips.choose(number)
        true = choice.file.read(choice.context).observations.depth[-1]
        share = clips.read(choice, images=False).context.depth[-1] / true
        errors.setdefault((choice.context, choice.noise_seed), []).append(share[SIZE // 2, SIZE // 2].item())
    assert all(len(set(same)) == 1 for same in errors.values())
    assert len({same[0] for same in errors.values()}) == len(errors) == 6


def test_fixed_clips_do_not_depend_on_whether_there_is_a_context(walks):
    without, having = (ClipDataset([walks], plan(clips_per_trajectory=5, context_frames=frames)) for frames in (0, 5))
    for number in range(20):
        assert without.choose(number).frames == having.choose(number).frames


@pytest.mark.parametrize(("processes", "accumulation"), [(1, 1), (2, 1), (1, 4), (2, 2)])
def test_a_step_has_the_same_samples_with_any_number_of_processes_and_micro_batches(processes, accumulation):
    parts = [list(DistributedBatches(3, 5, 8, accumulation, process, processes)) for process in range(processes)]
    for step in (0, 1):
        micro_batches = slice(step * accumulation, (step + 1) * accumulation)
        numbers = sorted(number for part in parts for batch in part[micro_batches] for number in batch)
        assert numbers == list(range((3 + step) * 8, (4 + step) * 8))


def test_a_run_that_changes_its_number_of_processes_reads_every_clip_once_and_in_order():
    numbers = []
    for first, processes in ((0, 2), (2, 1), (4, 4)):  # two steps with each number of processes
        parts = [DistributedBatches(first, first + 2, 8, 2, process, processes) for process in range(processes)]
        numbers += [number for micro in zip(*parts, strict=True) for batch in micro for number in batch]
    assert numbers == [number for batch in DistributedBatches(0, 6, 8, 1, 0, 1) for number in batch]


def test_clips_that_cannot_be_drawn_are_reported_with_the_numbers(walks):
    with pytest.raises(DataError, match="a clip needs 65 frames, the longest trajectory has 24"):
        ClipDataset([walks], plan(frames=65))
    with pytest.raises(DataError, match="images are 32x32, the model takes 64x64"):
        ClipDataset([walks], plan(image_size=(64, 64)))
    with pytest.raises(RecipeError, match=r"cannot be shared by 3 processes .* give training.batch=6 training.acc"):
        DistributedBatches(0, 1, 8, 1, 0, 3)


@pytest.mark.parametrize(("batch", "accumulation", "processes"), [(8, 2, 3), (64, 8, 7), (6, 1, 4), (5, 4, 8)])
def test_a_run_that_lost_processes_is_told_how_to_keep_its_batch(batch, accumulation, processes):
    with pytest.raises(RecipeError, match="a run that has begun keeps its batch") as refused:
        DistributedBatches(1, 2, batch, accumulation, 0, processes)
    advice = re.search(r"give training.accumulation=(\d+) and launch (\d+) of them", str(refused.value))
    parts, fewer = int(advice[1]), int(advice[2])
    sizes = {len(rows) for rows in DistributedBatches(1, 2, batch, parts, 0, fewer)}
    assert not any(batch % more == 0 for more in range(fewer + 1, processes + 1))
    assert max(sizes) <= max(1, batch / (accumulation * processes))


def test_true_cells_stand_in_the_place_of_a_context_and_are_those_of_the_first_frame(walks, tmp_path):
    clips = ClipDataset([write_with_cells(walks, tmp_path / "cells")], plan(true_cells=1.0))
    starts = []
    for number in range(8):
        choice, sample = clips.choose(number), clips[number]
        assert sample.context is None
        assert torch.equal(sample.cells.classes, cells_around(choice.file, choice.frames[0]).classes)
        starts.append(choice.frames[0] >= CHANGE)
    assert any(starts)
    assert not all(starts)


def test_true_cells_change_neither_the_choice_of_clips_nor_that_of_contexts(walks, tmp_path):
    folder = write_with_cells(walks, tmp_path / "cells")
    plain, mixed = (ClipDataset([folder], plan(true_cells=share)) for share in (0.0, 0.5))
    choices = [(plain.choose(number), mixed.choose(number)) for number in range(20)]
    assert all(one.frames == other.frames and one.context == other.context for one, other in choices)
    assert {other.true_cells for _, other in choices} == {True, False}


def test_true_cells_that_the_data_do_not_have_are_one_line(walks):
    with pytest.raises(DataError, match="has no cells of its scene"):
        ClipDataset([walks], plan(true_cells=1.0))
