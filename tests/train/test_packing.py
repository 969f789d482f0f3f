"""Samples on their way between processes: all their tensors in one."""

from __future__ import annotations

import torch

from persist_cli.data.clips import ClipDataset, ClipPlan
from persist_cli.train.packing import pack, unpack
from tests.support.micro_runs import SIZE


def test_a_clip_is_the_same_after_its_way_through_one_tensor(walks):
    clips = ClipDataset([walks], ClipPlan(frames=9, strides=(1,), context_frames=12, seed=3, image_size=(SIZE, SIZE)))
    samples = [clips[number] for number in range(3)]
    packed = pack(samples)
    assert packed.tensors.dtype == torch.uint8
    for mine, other in zip(samples, unpack(packed), strict=True):
        assert (mine.info.scene, mine.info.vocabulary) == (other.info.scene, other.info.vocabulary)
        assert (mine.clip.seed, mine.clip.interactions) == (other.clip.seed, other.clip.interactions)
        for one, two in ((mine.clip.observations, other.clip.observations), (mine.context, other.context)):
            assert torch.equal(one.rgb, two.rgb)
            assert torch.equal(one.depth, two.depth)
            assert torch.equal(one.cameras.world_from_camera, two.cameras.world_from_camera)


def test_tensors_of_every_type_and_shape_come_back():
    tensors = [
        torch.arange(5, dtype=torch.uint8), torch.tensor(2.5, dtype=torch.float64), torch.zeros(0, 3),
        torch.arange(12).view(3, 4).T, torch.tensor([True, False]), torch.randn(2, 3).to(torch.bfloat16),
        torch.ones(2, 1).expand(2, 4),
    ]  # fmt: skip
    found = unpack(pack([{"a": tensors}, ValueError("said")]))
    assert str(found[1]) == "said"
    for mine, other in zip(tensors, found[0]["a"], strict=True):
        assert mine.dtype == other.dtype
        assert torch.equal(mine, other)
