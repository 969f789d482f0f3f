"""Memory interventions: what is written into a row's memory in place of the true frames."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from persist_cli.api.geometry import pose_differences, small_motions
from persist_cli.data.store import Store
from persist_cli.evaluate.cases import read_case
from persist_cli.evaluate.protocols import PROTOCOLS, ClipSearch
from persist_cli.evaluate.rows.build_rows import no_cells
from persist_cli.evaluate.rows.controls import NoisyWarp
from persist_cli.evaluate.rows.interventions import (
    DRIFT_FRAMES,
    DriftingPoses,
    Emptied,
    NoisyPoses,
    Oracle,
    Shuffled,
    TrueCells,
    one_scene,
)
from tests.support.cell_walks import cells_around, write_with_cells


@pytest.fixture(scope="module")
def cases(held_out):
    return PROTOCOLS["revisit"].find(ClipSearch(folders=[held_out], frames=0, limit=8, predicted_at_once=8))


def test_a_shuffled_memory_holds_another_scene_moved_to_where_the_clip_begins(cases):
    clip, partner = read_case(cases[0]), read_case(cases[1])
    wrong = Shuffled(cases).context(clip)
    assert torch.equal(wrong.rgb, partner.context.rgb)
    here, moved = clip.observations.cameras.world_from_camera[0], wrong.cameras.world_from_camera[-1]
    assert torch.allclose(here, moved, atol=1e-9)


def test_shuffling_needs_another_scene(cases):
    assert one_scene(cases) is None
    assert one_scene([replace(case, scene="kitchen") for case in cases]) == (
        "needs clips of two scenes, all are of 'kitchen'"
    )


def test_a_house_in_two_data_sets_is_one_house_whose_memory_is_not_shuffled_into_itself(cases):
    again = [replace(cases[0], data="elsewhere"), *cases]
    assert Shuffled(again).partners[again[0]].scene == cases[1].scene
    assert one_scene(again[:2]) == f"needs clips of two scenes, all are of {cases[0].scene!r}"


def test_the_oracle_holds_the_frames_of_the_clip_and_the_emptied_memory_none(cases):
    clip = read_case(cases[0])
    assert torch.equal(Oracle().context(clip).rgb[-9:], clip.observations.rgb)
    assert Emptied().context(clip) is None


def test_a_scene_of_true_cells_begins_with_those_of_the_clips_first_frame_and_no_frames(held_out, tmp_path):
    folder = write_with_cells(held_out, tmp_path / "cells")
    case = PROTOCOLS["revisit"].find(ClipSearch(folders=[folder], frames=0, limit=8, predicted_at_once=8))[0]
    clip = read_case(case)
    assert TrueCells().context(clip) is None
    assert torch.equal(TrueCells().cells(clip).classes, cells_around(case.file, case.start).classes)
    assert no_cells([case]) is None


def test_true_cells_need_data_that_have_some(cases):
    assert no_cells(cases).startswith("needs the cells of every scene, which")


def test_noisy_poses_have_errors_of_the_given_deviations(held_out):
    seen = Store(held_out)[0].read().observations
    many = seen[[0] * 4000]
    wrong = NoisyPoses(5.0, 2.0).disturb(many, torch.Generator().manual_seed(0))
    metres, degrees = pose_differences(many.cameras.world_from_camera, wrong.cameras.world_from_camera)
    assert float(metres.square().mean().sqrt()) == pytest.approx(0.05 * 3**0.5, rel=0.05)
    assert float(degrees.square().mean().sqrt()) == pytest.approx(2.0 * 3**0.5, rel=0.05)
    assert torch.equal(wrong.rgb, many.rgb)


def test_noise_of_no_deviation_changes_no_pose(held_out):
    seen = Store(held_out)[0].read().observations
    same = NoisyPoses(0.0, 0.0).disturb(seen, torch.Generator().manual_seed(0))
    assert torch.equal(same.cameras.world_from_camera, seen.cameras.world_from_camera)


def test_drifting_poses_are_exact_where_the_clip_begins_and_off_by_the_deviation_after_32_frames(cases):
    clip = read_case(cases[0])
    still = clip.observations[[0] * (DRIFT_FRAMES + 1)]
    far = []
    for seed in range(200):
        seen = DriftingPoses(5.0, 2.0).disturber(replace(clip, context=still), seed)(still)
        metres, degrees = pose_differences(still.cameras.world_from_camera, seen.cameras.world_from_camera)
        assert float(metres[-1]) + float(degrees[-1]) == pytest.approx(0, abs=1e-5)
        far.append((float(metres[0]), float(metres[1] - metres[0])))
    first, change = torch.tensor(far).square().mean(0).sqrt().tolist()
    assert first == pytest.approx(0.05 * 3**0.5, rel=0.15)
    assert change < first / 3  # the error of one frame is near that of the next


def test_drift_goes_on_from_clip_to_clip_where_the_memory_begins_empty(cases):
    clip = replace(read_case(cases[0]), context=None)
    frames = clip.observations[[0] * 8]
    disturb = DriftingPoses(5.0, 2.0).disturber(clip, 0)
    poses = torch.cat([disturb(part).cameras.world_from_camera for part in (frames[:1], frames, frames)])
    metres, _ = pose_differences(poses[:-1], poses[1:])
    assert torch.equal(poses[0], frames.cameras.world_from_camera[0])
    assert (metres < 0.05).all()


@pytest.mark.parametrize("noise", [NoisyPoses(5.0, 2.0), DriftingPoses(5.0, 2.0)])
def test_a_warp_beside_noisy_memories_has_the_same_errors(cases, noise):
    clip = read_case(cases[0])
    known = NoisyWarp(None, False, noise).earlier(clip, 8, 3)
    written = noise.disturber(clip, 3)(clip.context)
    assert torch.equal(known.cameras.world_from_camera[: len(written)], written.cameras.world_from_camera)
    assert torch.equal(known.cameras.world_from_camera[len(written) :], clip.observations.cameras.world_from_camera)
    empty, disturb = replace(clip, context=None), noise.disturber(replace(clip, context=None), 3)
    parts = [disturb(clip.observations[:1]), disturb(clip.observations[1:])]
    known = NoisyWarp(None, True, noise).earlier(empty, 8, 3)
    assert torch.equal(known.cameras.world_from_camera, torch.cat([part.cameras.world_from_camera for part in parts]))


def test_small_motions_are_rigid():
    motions = small_motions(torch.ones(2, 3).double(), torch.tensor([[0.1, 0.2, 0.3], [0.0, 0.0, 0.0]]).double())
    assert torch.allclose(motions[:, :3, :3] @ motions[:, :3, :3].transpose(1, 2), torch.eye(3).double())
    assert torch.equal(motions[1, :3, :3], torch.eye(3).double())
