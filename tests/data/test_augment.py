"""Views for training: whatever is cut, mirrored or coloured, clip and memory keep one exact geometry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from persist_cli.api.geometry import project, unproject
from persist_cli.data.augment import Augmentation, View, mirrored_cameras, random_window
from persist_cli.data.clips import ClipDataset, ClipPlan
from persist_cli.data.images import CropResize
from persist_cli.data.store import Store
from persist_cli.errors import DataError
from tests.support.micro_runs import SIZE

ALL = Augmentation(crop=0.5, mirror=0.5, color_jitter=0.3)


def plan(**changes) -> ClipPlan:
    return ClipPlan(
        **{"frames": 9, "strides": (1,), "context_frames": 5, "seed": 3, "image_size": (SIZE, SIZE)} | changes
    )


def depth_error(frames) -> float:
    """Median metres by which the surface seen in frame 0 is off in frame 1, where both see it."""
    pixels, depth = project(unproject(frames.depth[:1], frames.cameras[:1]).reshape(1, -1, 3), frames.cameras[1:2])
    columns, rows = pixels[0].floor().long().unbind(-1)
    inside = (columns >= 0) & (columns < SIZE) & (rows >= 0) & (rows < SIZE) & (frames.depth[0].reshape(-1) > 0)
    surface = frames.depth[1][rows[inside], columns[inside]]
    return float((surface - depth[0][inside]).abs().median())


@pytest.mark.parametrize("mirrored", [False, True])
def test_frames_of_a_view_agree_with_each_other_as_the_recorded_ones_do(walks, mirrored):
    file = Store(walks)[0]
    frames = file.read(slice(0, 2)).observations
    view = View(CropResize(3, 6, (20, 20), (SIZE, SIZE)), mirrored, (1.0, 1.0, 1.0))
    seen = view.observations(frames, file.info.world_up)
    assert depth_error(seen) < 1.5 * depth_error(frames) + 0.01
    assert depth_error(replace(seen, cameras=frames.cameras)) > 2 * depth_error(seen)


def test_a_window_shows_the_points_of_the_pixels_that_it_is_cut_from(walks):
    file = Store(walks)[0]
    frames = file.read(slice(0, 1)).observations
    seen = View(CropResize(4, 8, (16, 16), (SIZE, SIZE)), False, (1.0, 1.0, 1.0)).observations(
        frames, file.info.world_up
    )
    whole, window = unproject(frames.depth, frames.cameras)[0, 4:20, 8:24], unproject(seen.depth, seen.cameras)[0]
    assert float((window.reshape(16, 2, 16, 2, 3).mean((1, 3)) - whole).norm(dim=-1).median()) < 0.01


def test_mirroring_twice_is_the_identity_and_heights_stay(walks):
    file = Store(walks)[0]
    cameras, up = file.cameras([0, 5]), file.info.world_up
    once = mirrored_cameras(cameras, up)
    heights = [one.centers @ torch.tensor(up, dtype=torch.float64) for one in (cameras, once)]
    assert torch.allclose(*heights)
    assert torch.linalg.det(once.world_from_camera[:, :3, :3]).tolist() == pytest.approx([1.0, 1.0])
    assert torch.allclose(mirrored_cameras(once, up).world_from_camera, cameras.world_from_camera)
    assert not torch.allclose(once.world_from_camera, cameras.world_from_camera)


def test_in_an_image_that_is_no_square_a_mirrored_camera_is_turned_round_along_its_rows(walks):
    cameras = replace(Store(walks)[0].cameras([0]), width=200)
    cameras.intrinsics[:, 0, 2] = 30
    assert float(mirrored_cameras(cameras, (0.0, 1.0, 0.0)).intrinsics[0, 0, 2]) == 170


def test_a_window_may_lie_anywhere_in_an_image_that_is_no_square():
    random = np.random.default_rng(0)
    windows = [random_window((24, 64), (8, 16), 0.5, random) for _ in range(500)]
    assert {(one.window, one.size) for one in windows} == {((12, 24), (8, 16))}
    for places, last in (([one.top for one in windows], 12), ([one.left for one in windows], 40)):
        assert (min(places), max(places)) == (0, last)


def test_each_colour_has_its_factor_and_what_becomes_too_bright_is_white(walks):
    frames = Store(walks)[0].read(slice(0, 1)).observations
    grey = replace(frames, rgb=torch.full_like(frames.rgb, 200))
    seen = View(None, False, (2.0, 1.0, 0.5)).observations(grey, (0.0, 1.0, 0.0))
    assert seen.rgb[0, 0, 0].tolist() == [255, 200, 100]


def test_clip_and_memory_are_one_view(walks):
    clips = ClipDataset([walks], plan(augmentation=ALL))
    for number in range(8):
        sample = clips[number]
        assert torch.equal(sample.context.rgb[-1], sample.clip.observations.rgb[0])
        assert torch.equal(sample.context.cameras.intrinsics[-1], sample.clip.observations.cameras.intrinsics[0])
        assert sample.clip.observations.rgb.shape == (9, SIZE, SIZE, 3)


def test_a_fixed_clip_has_a_fixed_view_and_each_clip_its_own(walks):
    clips = ClipDataset([walks], plan(augmentation=ALL, clips_per_trajectory=2))
    views = {}
    for number in range(40):
        choice = clips.choose(number)
        key = (choice.file.name, choice.frames, choice.context)
        assert views.setdefault(key, choice.view) == choice.view
    assert len(set(views.values())) == len(views) > 2


def test_cameras_alone_get_the_view_of_their_images(walks):
    clips = ClipDataset([walks], plan(augmentation=ALL))
    whole, bare = clips[3], clips.read(clips.choose(3), images=False, context=False)
    assert torch.equal(bare.clip.observations.cameras.intrinsics, whole.clip.observations.cameras.intrinsics)
    assert torch.equal(
        bare.clip.observations.cameras.world_from_camera, whole.clip.observations.cameras.world_from_camera
    )


def test_images_may_be_larger_than_the_models_where_it_takes_windows_of_them(walks):
    smaller = (SIZE // 2, SIZE // 2)
    sample = ClipDataset([walks], plan(augmentation=ALL, image_size=smaller))[0]
    assert sample.clip.observations.rgb.shape[1:3] == smaller
    for refused in (plan(image_size=smaller), plan(augmentation=ALL, image_size=(2 * SIZE, 2 * SIZE))):
        with pytest.raises(DataError, match="the model takes"):
            ClipDataset([walks], refused)


def test_without_augmentation_no_random_number_is_drawn(walks):
    random = np.random.default_rng(0)
    assert Augmentation().draw(Store(walks)[0].info, (SIZE, SIZE), random) is None
    assert random.random() == np.random.default_rng(0).random()


def test_views_are_mirrored_cut_and_coloured_as_often_and_as_far_as_the_settings_say(walks):
    info, random = Store(walks)[0].info, np.random.default_rng(0)
    drawn = [Augmentation(crop=0.5, mirror=0.25, color_jitter=0.3).draw(info, (SIZE, SIZE), random) for _ in range(400)]
    assert np.mean([view.mirrored for view in drawn]) == pytest.approx(0.25, abs=0.06)
    heights = np.array([view.window.window[0] / SIZE for view in drawn])
    assert (heights.min(), heights.max()) == pytest.approx((0.5, 1.0), abs=0.03)
    assert heights.std() > 0.1
    gains = np.array([view.gains for view in drawn])
    assert gains.min() >= 0.7**2
    assert 1.3 < gains.max() <= 1.3**2
    assert gains.mean() == pytest.approx(1.0, abs=0.03)
