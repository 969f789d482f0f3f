"""Memory interventions: what is written into a row's memory in place of the true frames."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from persist_cli.api.geometry import pose_differences
from persist_cli.data.store import Store
from persist_cli.evaluate.cases import read_case
from persist_cli.evaluate.protocols import PROTOCOLS, ClipSearch
from persist_cli.evaluate.rows.interventions import (
    Emptied,
    NoisyPoses,
    Oracle,
    Shuffled,
    one_scene,
    small_motions,
)


@pytest.fixture(scope="module")
def cases(walks):
    return PROTOCOLS["revisit"].find(ClipSearch([walks], 0, 8, 8))


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


def test_the_oracle_holds_the_frames_of_the_clip_and_the_emptied_memory_none(cases):
    clip = read_case(cases[0])
    assert torch.equal(Oracle().context(clip).rgb[-9:], clip.observations.rgb)
    assert Emptied().context(clip) is None


def test_noisy_poses_have_errors_of_the_given_deviations(walks):
    seen = Store(walks)[0].read().observations
    many = seen[[0] * 4000]
    wrong = NoisyPoses(5.0, 2.0).disturb(many, torch.Generator().manual_seed(0))
    metres, degrees = pose_differences(many.cameras.world_from_camera, wrong.cameras.world_from_camera)
    assert float(metres.square().mean().sqrt()) == pytest.approx(0.05 * 3**0.5, rel=0.05)
    assert float(degrees.square().mean().sqrt()) == pytest.approx(2.0 * 3**0.5, rel=0.05)
    assert torch.equal(wrong.rgb, many.rgb)


def test_noise_of_no_deviation_changes_no_pose(walks):
    seen = Store(walks)[0].read().observations
    same = NoisyPoses(0.0, 0.0).disturb(seen, torch.Generator().manual_seed(0))
    assert torch.equal(same.cameras.world_from_camera, seen.cameras.world_from_camera)


def test_small_motions_are_rigid():
    motions = small_motions(torch.ones(2, 3).double(), torch.tensor([[0.1, 0.2, 0.3], [0.0, 0.0, 0.0]]).double())
    assert torch.allclose(motions[:, :3, :3] @ motions[:, :3, :3].transpose(1, 2), torch.eye(3).double())
    assert torch.equal(motions[1, :3, :3], torch.eye(3).double())
