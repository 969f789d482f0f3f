"""tests.evaluate.test_controls."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from persist_cli.api.observations import Observations
from persist_cli.checkpoints.checkpoint import find_checkpoint, load_backbone
from persist_cli.data.store import Store
from persist_cli.evaluate.cases import read_case
from persist_cli.evaluate.protocols import PROTOCOLS, Selected
from persist_cli.evaluate.rows.controls import CodecReconstruction, Copy, Nearest, Warp
from persist_cli.evaluate.rows.warp import Surface, warp
from tests.support.rooms import Room, look


def room(*poses: np.ndarray, size: int = 64) -> Observations:
    view = Room(size, size)
    frames = [view.see(pose) for pose in poses]
    whole = torch.from_numpy
    from persist_cli.api.cameras import Cameras

    cameras = Cameras(whole(np.stack(poses)), whole(view.intrinsics).expand(len(poses), 3, 3), view.height, view.width)
    rgb, depth = (np.stack([getattr(frame, name) for frame in frames]) for name in ("rgb", "depth"))
    return Observations(whole(rgb), whole(depth), cameras)


def warped(seen: Observations, asked: Observations) -> tuple[torch.Tensor, torch.Tensor]:
    """The view asked for, colours from the last frame that shows a surface."""
    return warp(Surface.of(seen), asked.cameras, -torch.arange(len(seen)).double())


@pytest.fixture(scope="module")
def backbone(stage1):
    return load_backbone(find_checkpoint(stage1))


@pytest.fixture(scope="module")
def revisits(walks):
    return [read_case(case) for case in PROTOCOLS["revisit"].find(Selected([walks], 0, 8, 8))]


def test_a_view_warped_into_itself_is_itself():
    seen = room(look((0.0, 1.3, 0.2), 30.0))
    rgb, depth = warped(seen, seen)
    assert torch.equal(rgb, seen.rgb[0])
    assert torch.allclose(depth, seen.depth[0])


def test_a_warp_shows_the_new_view_better_than_the_old_frame_does():
    old, new = room(look((0.0, 1.3, 0.2), 30.0)), room(look((0.1, 1.3, 0.1), 22.0))
    rgb, depth = warped(old, new)
    error, frozen = ((shown.float() - new.rgb[0].float()).abs().mean() for shown in (rgb, old.rgb[0]))
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
    seen, behind = room(look((0.0, 1.3, 0.0), 0.0, 0.0)), room(look((0.0, 1.3, 0.0), 180.0, 0.0))
    rgb, depth = warped(seen, behind)
    assert not rgb.any()
    assert not depth.any()


def test_copy_repeats_the_given_frame(backbone, revisits):
    rgb, _ = Copy("copy", None).videos(backbone, revisits, [0, 0])
    assert torch.equal(rgb[0, 5], revisits[0].observations.rgb[0])


def test_the_nearest_frame_at_a_pose_seen_before_is_the_true_one(backbone, revisits):
    for row in (Nearest("nearest", None, writes=False), Warp("warp", None, writes=False)):
        rgb, _ = row.videos(backbone, revisits[:1], [0])
        assert (rgb[0] == revisits[0].observations.rgb).all(-1).float().mean() > 0.9


def test_controls_know_only_what_the_memory_holds_by_then(backbone, walks):
    case = PROTOCOLS["return"].find(Selected([walks], 0, 1, 8))[0]
    clip = read_case(case)
    row = Nearest("nearest", None, writes=True)
    assert row.held(clip, 8, 8).nonzero()[:, 0].tolist() == [0]
    assert row.held(clip, 9, 8).nonzero()[:, 0].tolist() == list(range(9))
    rgb, _ = row.videos(backbone, [clip], [0])
    assert torch.equal(rgb[0, 8], clip.observations.rgb[0])


def test_the_codec_gives_as_many_frames_as_the_clip_has(backbone, walks):
    clip = read_case(PROTOCOLS["return"].find(Selected([walks], 0, 1, 8))[0])
    rgb, depth = CodecReconstruction("codec", None).videos(backbone, [clip], [0])
    assert rgb.shape[1] == depth.shape[1] == len(clip.observations) == 24
    assert torch.equal(rgb[0, 0], clip.observations.rgb[0])


def test_walks_are_long_enough_for_these_tests(walks):
    assert {len(file) for file in Store(walks)} == {24}
