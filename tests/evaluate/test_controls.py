"""Controls that need no training: copies, warps and the codec."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.api.geometry import unproject
from persist_cli.api.observations import Observations
from persist_cli.checkpoints.load import load_backbone
from persist_cli.data.store import Store
from persist_cli.evaluate.cases import read_case
from persist_cli.evaluate.new_poses import NewPoses
from persist_cli.evaluate.protocols import PROTOCOLS, ClipSearch
from persist_cli.evaluate.rows.controls import CodecReconstruction, Copy, Nearest, Warp, pose_distances
from persist_cli.evaluate.rows.warp import Surface, warp
from tests.support.predictions import observe_room
from tests.support.rooms import Room, look


def room(*poses: np.ndarray) -> Observations:
    """Views of the furnished room from these poses."""
    return observe_room(np.stack(poses), Room(64, 64))


def warped(earlier: Observations, view: Observations) -> tuple[torch.Tensor, torch.Tensor]:
    """The view made of earlier frames, colours from the last frame that shows a surface."""
    return warp(Surface.of(earlier), view.cameras, -torch.arange(len(earlier)).double())


@pytest.fixture(scope="module")
def backbone(stage1):
    return load_backbone(find_checkpoint(stage1))


@pytest.fixture(scope="module")
def revisits(held_out):
    return [
        read_case(case)
        for case in PROTOCOLS["revisit"].find(ClipSearch(folders=[held_out], frames=0, limit=8, predicted_at_once=8))
    ]


def test_a_view_warped_into_itself_is_itself():
    view = room(look((0.0, 1.3, 0.2), 30.0))
    rgb, depth = warped(view, view)
    assert torch.equal(rgb, view.rgb[0])
    assert torch.allclose(depth, view.depth[0])


def test_a_warp_shows_the_new_view_better_than_the_old_frame_does():
    old, new = room(look((0.0, 1.3, 0.2), 30.0)), room(look((0.1, 1.3, 0.1), 22.0))
    rgb, depth = warped(old, new)
    error, frozen = ((image.float() - new.rgb[0].float()).abs().mean() for image in (rgb, old.rgb[0]))
    assert error < 0.5 * frozen
    assert float((depth - new.depth[0]).abs().median()) < 0.02


def test_the_warp_shows_the_nearer_surface_whichever_frame_comes_last():
    near, far = room(look((1.0, 1.3, -1.0), 180.0)), room(look((-2.0, 1.3, -1.0), 180.0))
    both = Observations.concatenate([near, far])
    for order in ([0, 1], [1, 0]):
        rgb, depth = warped(both[order], near)
        assert ((depth - near.depth[0]).abs() < 0.05 * near.depth[0]).float().mean() > 0.97
    assert (rgb == near.rgb[0]).all(-1).float().mean() > 0.99


def test_a_warp_of_nothing_in_view_is_black_without_depth():
    ahead, behind = room(look((0.0, 1.3, 0.0), 0.0, 0.0)), room(look((0.0, 1.3, 0.0), 180.0, 0.0))
    rgb, depth = warped(ahead, behind)
    assert not rgb.any()
    assert not depth.any()


def test_copy_repeats_the_given_frame(backbone, revisits):
    rgb, _ = Copy("copy", None).videos(backbone, revisits, [0, 0])
    assert torch.equal(rgb[0, 5], revisits[0].observations.rgb[0])


def test_the_nearest_frame_at_a_pose_seen_before_is_the_true_one(backbone, walks):
    every_frame = ClipSearch(folders=[walks], frames=0, limit=8, predicted_at_once=8, new_poses=NewPoses(0, 0))
    clip = read_case(PROTOCOLS["revisit"].find(every_frame)[0])
    for row in (Nearest("nearest", None, writes=False), Warp("warp", None, writes=False)):
        rgb, _ = row.videos(backbone, [clip], [0])
        assert (rgb[0] == clip.observations.rgb).all(-1).float().mean() > 0.9


def test_the_nearest_frame_is_taken_from_what_the_memory_holds_by_then(backbone, held_out):
    case = PROTOCOLS["return"].find(ClipSearch(folders=[held_out], frames=0, limit=1, predicted_at_once=8))[0]
    clip = read_case(case)
    row = Nearest("nearest", None, writes=True)
    assert row.held(clip, 8, 8).nonzero()[:, 0].tolist() == [0]
    assert row.held(clip, 9, 8).nonzero()[:, 0].tolist() == list(range(9))
    rgb, _ = row.videos(backbone, [clip], [0])
    assert torch.equal(rgb[0, 8], clip.observations.rgb[0])


def test_the_codec_gives_as_many_frames_as_the_clip_has(backbone, held_out):
    clip = read_case(
        PROTOCOLS["return"].find(ClipSearch(folders=[held_out], frames=0, limit=1, predicted_at_once=8))[0]
    )
    rgb, depth = CodecReconstruction("codec", None).videos(backbone, [clip], [0])
    assert rgb.shape[1] == depth.shape[1] == len(clip.observations) == 24
    assert torch.equal(rgb[0, 0], clip.observations.rgb[0])


def test_walks_have_the_24_frames_that_these_tests_count_on(held_out):
    assert {len(file) for file in Store(held_out)} == {24}


def test_a_pose_is_as_far_as_its_metres_and_radians_together():
    cameras = room(look((0.0, 1.3, 0.0), 0.0), look((0.5, 1.3, 0.0), 0.0), look((0.0, 1.3, 0.0), 90.0)).cameras
    assert pose_distances(cameras, cameras[0]).tolist() == pytest.approx([0.0, 0.5, np.pi / 2], abs=1e-6)


def test_a_warp_shows_no_surface_through_a_nearer_one_nor_through_a_crack_between_its_points():
    camera = room(look((0.0, 1.3, 0.0), 0.0)).cameras
    near, far = (unproject(torch.full((1, 64, 64), depth), camera).reshape(-1, 3) for depth in (1.0, 2.0))
    near = torch.cat([near[: 64 * 32 + 32], near[64 * 32 + 33 :]])  # without one pixel in the middle
    frames = torch.tensor([0] * len(near) + [1] * len(far))
    colors = torch.tensor([[200, 0, 0], [0, 200, 0]], dtype=torch.uint8)[frames]
    rgb, depth = warp(Surface(torch.cat([near, far]), colors, frames), camera, torch.tensor([1.0, 0.0]).double())
    assert (rgb == torch.tensor([200, 0, 0])).all()
    assert depth.allclose(torch.ones(64, 64))
