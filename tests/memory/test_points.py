"""A point cloud: points with the features of their pixels, which reads sample evenly and nothing pools."""

from dataclasses import replace

import torch

from persist_cli.api.geometry import project
from persist_cli.api.memory import FrameOfReference
from persist_cli.api.observations import Origin
from persist_cli.plugins import make_encoder
from persist_memory.points.point_cloud import PointCloud, PointCloudSettings, ranks
from tests.memory.test_origins import imagined
from tests.support.room_views import moved, room_walk, same_bits, translation
from tests.support.rooms import UP


def cloud(*parts, **settings) -> PointCloud:
    """A cloud into which these frames were written one part after the other."""
    memory = PointCloud(PointCloudSettings(**settings), make_encoder("patches", {}), FrameOfReference("room", UP))
    for part in parts:
        memory.write(part)
    return memory


def test_an_empty_cloud_gives_no_token_and_has_no_bounds():
    tokens = cloud().read(room_walk(2).cameras, 100)
    assert tokens.features.shape == (0, 32)
    assert cloud().figures().bounds is None


def test_a_point_lies_on_its_pixel_and_has_its_colour_and_upsampled_feature():
    frame = room_walk(1)
    stored = cloud(frame, stride=16).tensors()
    pixels, depth = (part[0] for part in project(stored["positions"][None], frame.cameras))
    column, row = pixels.floor().long().unbind(-1)
    torch.testing.assert_close(depth.float(), frame.depth[0, row, column])
    assert torch.equal(stored["colors"], frame.rgb[0, row, column])
    maps = make_encoder("patches", {}).encode(frame.rgb).permute(0, 3, 1, 2)
    whole = torch.nn.functional.interpolate(maps, size=frame.depth.shape[1:], mode="bilinear", align_corners=False)
    torch.testing.assert_close(stored["features"], whole[0][:, row, column].T, atol=1e-5, rtol=1e-5)


def test_a_place_seen_from_two_frames_has_points_of_both_and_a_frame_written_twice_has_them_once():
    frames = room_walk(2)
    both, first = cloud(frames), cloud(frames[:1])
    assert len(both.tensors()["positions"]) == len(first.tensors()["positions"]) + len(
        cloud(frames[1:]).tensors()["positions"]
    )
    assert same_bits(cloud(frames, frames), both)


def test_neither_the_order_of_writing_nor_saving_changes_a_bit():
    frames = room_walk(4)
    memory, restored = cloud(frames), cloud()
    assert same_bits(memory, cloud(frames[2:], frames[:2]))
    restored.restore(memory.tensors())
    assert same_bits(memory, restored)
    merged = cloud(frames[:2])
    merged.merge(cloud(frames[2:]))
    assert same_bits(memory, merged)


def test_a_read_gives_points_in_view_alone_and_a_smaller_budget_gives_the_first_of_them():
    frames = room_walk(6)
    memory, cameras = cloud(frames), frames[:1].cameras
    tokens, few = memory.read(cameras, 10_000), memory.read(cameras, 20)
    pixels, depth = project(tokens.positions[None], cameras)
    assert bool((depth > 0).all() and (pixels >= 0).all() and (pixels < pixels.new_tensor([64, 48])).all())
    assert 20 < len(tokens) < len(memory.tensors()["positions"])
    assert torch.equal(few.positions, tokens.positions[:20])
    assert len(memory.read(cameras, 0)) == 0


def test_a_sample_of_the_points_in_view_is_spread_over_the_image():
    frames = room_walk(6)
    pixels, _ = project(cloud(frames).read(frames[:1].cameras, 100).positions[None], frames[:1].cameras)
    quarters = (pixels[0, :, 0] >= 32).long() + 2 * (pixels[0, :, 1] >= 24).long()
    assert torch.bincount(quarters, minlength=4).min() >= 8


def test_moving_the_worlds_origin_moves_the_tokens_and_changes_nothing_else():
    frames, shift = room_walk(4), translation(40.0, -2.0, 7.0)
    one, other = cloud(frames), cloud(moved(frames, shift))
    here = one.read(frames.cameras, 50)
    there = other.read(moved(frames, shift).cameras, 50)
    assert torch.equal(here.features, there.features)
    torch.testing.assert_close(here.positions + shift[:3, 3], there.positions)


def test_ranks_differ_where_any_feature_the_colour_or_the_place_in_the_frame_does():
    features = torch.ones(1000, 32)
    features[:, 31] = torch.arange(1000)
    colors, plain = torch.zeros(1000, 3, dtype=torch.uint8), torch.ones(1000, 32)
    here = torch.zeros(1000, 1, dtype=torch.int64)
    assert len(ranks(features, colors, here).unique()) == 1000
    colors[:, 2] = torch.arange(1000) % 250
    assert len(ranks(plain, colors, here).unique()) == 250
    assert len(ranks(plain, colors, torch.arange(1000)[:, None]).unique()) == 1000
    swapped = torch.tensor([[1.0, 2.0], [2.0, 1.0]])
    assert len(ranks(swapped, colors[:2], here[:2]).unique()) == 2


def test_a_sample_of_a_plain_wall_is_spread_over_it():
    frame = room_walk(1)
    wall = replace(frame, rgb=torch.full_like(frame.rgb, 90), depth=torch.full_like(frame.depth, 2.0))
    pixels, _ = project(cloud(wall, stride=2).read(wall.cameras, 100).positions[None], wall.cameras)
    quarters = (pixels[0, :, 0] >= 32).long() + 2 * (pixels[0, :, 1] >= 24).long()
    assert torch.bincount(quarters, minlength=4).min() >= 12


def test_imagined_points_change_no_observed_one_and_give_way_to_observations_near_them():
    walk = room_walk(5)
    memory = cloud(walk[:3])
    before = memory.tensors()["positions"]
    memory.write(imagined(walk))
    observed = memory.tensors()["origins"] == Origin.OBSERVED
    assert torch.equal(memory.tensors()["positions"][observed], before)
    dreamt = cloud(imagined(walk), spread=1.0)
    assert dreamt.figures().imagined == dreamt.figures().cells
    count = dreamt.figures().imagined
    dreamt.write(walk)
    assert dreamt.figures().imagined < count / 4


def test_an_image_smaller_than_the_stride_gives_a_point_all_the_same():
    frame = room_walk(1)
    assert len(cloud(frame, stride=1000).tensors()["positions"]) == 1


def test_two_frames_of_one_pose_that_look_different_have_points_of_both():
    frame = room_walk(1)
    both = cloud(frame, replace(frame, rgb=255 - frame.rgb))
    assert len(both.tensors()["positions"]) == 2 * len(cloud(frame).tensors()["positions"])


def test_a_pixel_as_far_as_the_greatest_depth_is_a_point():
    frame = room_walk(1)
    wall = replace(frame, depth=torch.full_like(frame.depth, 2.0))
    assert len(cloud(wall, max_depth=2.0).tensors()["positions"]) == len(cloud(wall).tensors()["positions"])
    assert not cloud(wall, max_depth=1.9).tensors()


def test_no_imagined_point_stands_in_the_air_before_an_observed_one():
    frame = room_walk(1)
    memory, before = cloud(frame), cloud(frame)
    memory.write(imagined(replace(frame, depth=0.5 * frame.depth)))
    assert same_bits(memory, before)
