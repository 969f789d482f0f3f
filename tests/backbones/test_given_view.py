"""The given frame, moved into the views of the frames to come (``backbone.settings.given=rendered``)."""

import dataclasses
from functools import partial

import pytest
import torch

from persist_backbones.cogvideox.diffusion import draw_timesteps, sample_generators
from persist_backbones.cogvideox.given_view import render_given
from persist_cli.api.backbone import Sampling
from persist_cli.errors import CheckpointError
from tests.support.micro_model import FRAMEWISE, equal, micro, random_clips
from tests.support.micro_runs import SIZE
from tests.support.room_views import room_walk

WALK = room_walk(36)  # steps of ten degrees


def views_of(cameras=WALK.cameras, depth=WALK.depth[0]):
    """What the first frame of the walk shows in all of its views."""
    clip = dataclasses.replace(
        cameras, world_from_camera=cameras.world_from_camera[None], intrinsics=cameras.intrinsics[None]
    )
    return render_given(WALK.rgb[:1], depth[None], clip)


def standing(clips):
    """The clips with cameras that stay where they begin."""
    poses = clips.cameras.world_from_camera[:, :1].expand_as(clips.cameras.world_from_camera)
    return dataclasses.replace(clips, cameras=dataclasses.replace(clips.cameras, world_from_camera=poses.clone()))


def condition(backbone, clips):
    """The image condition of clips, from the latents of their first frames."""
    known = backbone.known_latents(backbone.encode(clips).image, clips)
    return backbone.image_condition(known, backbone.shape.of(clips))


def test_the_given_frame_is_the_first_view_and_is_seen_again_from_where_it_was_taken():
    views = views_of(WALK.cameras[[0, 0, 18]])
    assert torch.equal(views.rgb[0, 0], WALK.rgb[0])
    assert torch.equal(views.depth[0, 0], WALK.depth[0])
    assert (views.covered[0, 1] > 0.99).all()
    assert (views.rgb[0, 1].float() - WALK.rgb[0]).abs().median() < 4
    assert (views.depth[0, 1] - WALK.depth[0]).abs().median() < 0.02


def test_what_it_shows_lies_where_the_truth_has_it():
    views = views_of()
    shown = views.covered[0, :, 0] > 0.5
    assert shown[1].float().mean() > 0.7
    assert shown[12:24].float().mean() < 0.1  # with its back to it
    for frame in (1, 2, 3):
        there = shown[frame]
        assert (views.depth[0, frame] - WALK.depth[frame]).abs()[there].median() < 0.03
        moved, kept = (
            (rgb.float() - WALK.rgb[frame]).abs()[there].mean() for rgb in (views.rgb[0, frame], WALK.rgb[0])
        )
        assert moved < 0.6 * kept


def test_where_the_world_begins_changes_nothing():
    turn = torch.tensor([[0, 0, 1, 5], [0, 1, 0, -2], [-1, 0, 0, 9], [0, 0, 0, 1]], dtype=torch.float64)
    moved = dataclasses.replace(WALK.cameras, world_from_camera=turn @ WALK.cameras.world_from_camera)
    one, two = views_of(), views_of(moved)
    assert (one.rgb != two.rgb).float().mean() < 1e-3
    assert torch.allclose(one.covered, two.covered, atol=0.3)


def test_missing_depth_draws_nothing():
    views = views_of(depth=torch.zeros_like(WALK.depth[0]))
    assert views.covered[:, 0].eq(1).all()
    assert views.covered[:, 1:].eq(0).all()
    assert views.depth.isfinite().all()


def test_alone_the_given_frame_says_nothing_of_later_ones():
    clips, backbone = random_clips(), micro()
    image = condition(backbone, clips)
    assert torch.equal(image[:, :1], backbone.encode(clips).image)
    assert image[:, 1:].eq(0).all()


@pytest.mark.parametrize("settings", [{}, FRAMEWISE], ids=["folded in time", "frame by frame"])
def test_rendered_it_fills_the_views_that_see_it_and_no_others(settings):
    backbone, clips = micro(given="rendered", **settings), standing(random_clips())
    behind = clips.cameras.world_from_camera.clone()
    behind[1, 1:, :3, :3] = torch.diag(torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64))
    clips = dataclasses.replace(clips, cameras=dataclasses.replace(clips.cameras, world_from_camera=behind))
    image = condition(backbone, clips)
    assert torch.equal(image[:, :1], backbone.encode(clips).image)
    assert image[0].ne(0).any(dim=1).all()
    assert image[1, 1:].eq(0).all()


def test_one_given_frame_serves_several_ways():
    backbone, clips = micro(given="rendered"), random_clips()
    shared = dataclasses.replace(clips, rgb=clips.rgb[:1], depth=clips.depth[:1])
    repeated = dataclasses.replace(
        clips, rgb=clips.rgb[:1].expand_as(clips.rgb), depth=clips.depth[:1].expand_as(clips.depth)
    )
    assert torch.allclose(backbone.encode_first(shared), backbone.encode_first(repeated), atol=1e-5)


def test_training_on_kept_latents_is_training_on_images():
    backbone, clips = micro(given="rendered", image_noise=0.5), random_clips()
    kept = dataclasses.replace(clips, latents=backbone.encode(clips), rgb=clips.rgb[:, :0], depth=clips.depth[:, :0])
    losses = [backbone(batch, "1")["loss"] for batch in (clips, kept)]
    assert equal(losses[:1], losses[1:])


def test_noise_on_the_given_frame_is_on_its_views_too_and_not_where_it_shows_nothing():
    clean, noisy = micro(given="rendered"), micro(given="rendered", image_noise=0.5)
    clips = random_clips()
    images = []
    for backbone in (clean, noisy):
        generators = sample_generators(clips.seeds)
        images.append(backbone.add_noise(clips, generators, partial(draw_timesteps, backbone.scheduler)).image)
    assert (images[0] - images[1])[:, 1:].std(dim=(2, 3, 4)).gt(0).all()
    assert torch.equal(images[0].any(dim=2), images[1].any(dim=2))


def test_a_clip_is_generated_and_its_later_frames_depend_on_the_given_one_and_its_depth():
    backbone, clips = micro(given="rendered"), random_clips(1)
    nearer = dataclasses.replace(clips, depth=clips.depth / 2)
    one, two = (backbone.generate(batch, Sampling(2))[0] for batch in (clips, nearer))
    assert one.shape == (1, 9, SIZE, SIZE, 3)
    assert not torch.equal(one[:, 1:], two[:, 1:])


def test_a_model_without_depth_cannot_move_a_frame():
    with pytest.raises(CheckpointError, match="given=rendered moves the given frame by its depth"):
        micro(given="rendered", depth=False)
