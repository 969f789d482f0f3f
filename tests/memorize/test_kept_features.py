"""Frames whose features are kept are found by their pixels and not encoded again."""

import torch

from persist_cli.api.encoder import Encoder
from persist_cli.memorize.kept_features import KeptFeatures, frame_digests
from persist_cli.plugins import make_encoder
from tests.support.room_views import room_walk

FRAMES = room_walk(5).rgb


class Counting(Encoder):
    """An encoder that counts the frames it encodes."""

    name, frames, channels = "counting", 0, 32

    def encode(self, rgb):
        self.frames += len(rgb)
        return make_encoder("patches", {}).encode(rgb)


def test_features_are_those_of_the_encoder_and_no_frame_is_encoded_twice():
    inner = Counting(None)
    kept, expected = KeptFeatures(inner), make_encoder("patches", {}).encode(FRAMES)
    assert torch.equal(kept.encode(FRAMES[:3]), expected[:3])
    assert torch.equal(kept.encode(FRAMES[[4, 1, 4, 0]]), expected[[4, 1, 4, 0]])
    assert torch.equal(kept.encode(FRAMES), expected)
    assert inner.frames == 5


def test_the_features_used_longest_ago_leave_first_when_there_is_no_room():
    inner = Counting(None)
    kept = KeptFeatures(inner, room=3 * make_encoder("patches", {}).encode(FRAMES[:1]).nbytes)
    kept.encode(FRAMES[:3])
    kept.encode(FRAMES[:1])
    kept.encode(FRAMES[3:4])  # the second one leaves
    assert [digest in kept for digest in frame_digests(FRAMES)] == [True, False, True, True, False]
    assert torch.equal(kept.encode(FRAMES), make_encoder("patches", {}).encode(FRAMES))
    assert kept.used <= kept.room


def test_what_is_kept_does_not_change_with_what_was_returned():
    kept = KeptFeatures(Counting(None))
    kept.encode(FRAMES[:1]).zero_()
    assert torch.equal(kept.encode(FRAMES[:1]), make_encoder("patches", {}).encode(FRAMES[:1]))


def test_frames_of_other_sizes_with_the_same_bytes_have_other_digests():
    assert frame_digests(FRAMES[:1]) != frame_digests(FRAMES[:1].transpose(1, 2).contiguous().reshape(1, 64, 48, 3))
    assert frame_digests(torch.zeros(1, 2, 8, 3, dtype=torch.uint8)) != frame_digests(
        torch.zeros(1, 8, 2, 3, dtype=torch.uint8)
    )
