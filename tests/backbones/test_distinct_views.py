"""Views that clips share are drawn and encoded once; the clips are as if each had drawn its own."""

import dataclasses

import pytest
import torch

from persist_backbones.adapters import rendered
from persist_backbones.cogvideox import given_view
from persist_backbones.distinct_views import distinct_views
from persist_cli.api.cameras import Cameras
from persist_cli.api.tokens import MemoryTokens
from tests.support.micro_model import CHANNELS, FRAMEWISE, micro, random_clips, random_tokens, with_adapter

CLIPS = random_clips(1)


def parting(clips=3, together=4, metres=0.5):
    """Clips of nine frames from one frame and one place, whose paths part after some frames."""
    poses = CLIPS.cameras.world_from_camera.repeat(clips, 1, 1, 1)
    for number in range(clips):
        poses[number, together:, 0, 3] += metres * number
    cameras = Cameras(poses, CLIPS.cameras.intrinsics.repeat(clips, 1, 1, 1), CLIPS.cameras.height, CLIPS.cameras.width)
    seeds, interactions = [*range(clips)], CLIPS.interactions * clips
    return dataclasses.replace(CLIPS, cameras=cameras, seeds=seeds, interactions=interactions)


def counting(monkeypatch, owner, name, argument):
    """A list that grows by the number of clips of each call of a function."""
    counts, function = [], getattr(owner, name)

    def counted(*arguments):
        counts.append(len(arguments[argument]))
        return function(*arguments)

    monkeypatch.setattr(owner, name, counted)
    return counts


def test_every_view_is_there_once_and_found_again():
    cameras = parting().cameras
    distinct, numbers = distinct_views(cameras)
    assert distinct.world_from_camera.shape[:2] == (3, 9)  # 4 + 3 × 5 = 19 views
    found = distinct.world_from_camera.flatten(0, 1)[numbers]
    assert torch.equal(found, cameras.world_from_camera)
    assert len(numbers.unique()) == 19


def test_views_that_differ_by_rounding_alone_are_one():
    poses = parting(2, together=9).cameras.world_from_camera.clone()
    poses[1, :, :3, 3] += 1e-13
    cameras = dataclasses.replace(parting(2).cameras, world_from_camera=poses)
    assert len(cameras.distinct()[0]) == 9
    poses[1, :, :3, 3] += 1e-6
    assert len(cameras.distinct()[0]) == 18


def test_clips_that_share_their_tokens_are_rendered_as_if_each_had_its_own(monkeypatch):
    backbone = with_adapter(micro(**FRAMEWISE), form="rendered", attention_tokens=0)
    clips, tokens = parting(5, together=8), random_tokens(1, 200)
    shared = MemoryTokens.stack([tokens[0]] * 5)
    copied = MemoryTokens(**{name: part.clone() for name, part in shared.tensors().items()})
    assert shared.shared
    assert not copied.shared
    own = backbone.keep_tokens(dataclasses.replace(clips, tokens=copied))
    counts = counting(monkeypatch, rendered, "render_views", 1)
    once = backbone.keep_tokens(dataclasses.replace(clips, tokens=shared))
    assert counts == [1, 1]  # 8 + 5 views
    assert torch.allclose(once.rendered, own.rendered, atol=2e-3)
    assert own.rendered.any()


def test_clips_that_share_their_tokens_attend_to_those_that_no_view_of_any_of_them_shows():
    backbone = with_adapter(micro(**FRAMEWISE), form="rendered", attention_tokens=200)
    clips, tokens = parting(together=1, metres=2.0), random_tokens(1, 200)
    shared = backbone.keep_tokens(dataclasses.replace(clips, tokens=MemoryTokens.stack([tokens[0]] * 3)))
    copies = [MemoryTokens(**{name: part.clone() for name, part in tokens[0].tensors().items()}) for _ in range(3)]
    own = backbone.keep_tokens(dataclasses.replace(clips, tokens=MemoryTokens.stack(copies)))
    attended = [[set(map(tuple, one.positions[one.mask].tolist())) for one in map(kept.__getitem__, range(3))]
                for kept in (shared, own)]  # fmt: skip
    assert all(few <= many for few, many in zip(*attended, strict=True))
    assert any(few < many for few, many in zip(*attended, strict=True))


@pytest.mark.parametrize("settings", [FRAMEWISE, {}])
def test_a_given_frame_of_several_clips_is_moved_as_if_each_had_its_own(settings, monkeypatch):
    backbone = micro(given="rendered", **settings)
    clips = parting(5, together=8)
    several = dataclasses.replace(clips, rgb=clips.rgb.repeat(5, 1, 1, 1, 1), depth=clips.depth.repeat(5, 1, 1, 1))
    own = backbone.encode_first(several)
    counts = counting(monkeypatch, given_view, "render_given", 2)
    once = backbone.encode_first(clips)
    assert counts == [1] * (2 if settings else 5)
    assert torch.allclose(once, own, atol=1e-3)
    assert own[:, 1:].any()


def test_a_batch_of_one_sample_several_times_is_not_copied():
    [sample] = [random_tokens(1, 7)[0]]
    batch = MemoryTokens.stack([sample, sample])
    assert batch.features.shape == (2, 7, CHANNELS)
    assert batch.features.untyped_storage().nbytes() == sample.features.untyped_storage().nbytes()
    assert batch.to("cpu").shared
    assert torch.equal(batch.to("cpu").positions, batch.positions)
    assert not MemoryTokens.stack([sample]).shared
