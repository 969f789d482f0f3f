"""The formulas of FLOPs that utilisation is computed with agree with torch's counter."""

import dataclasses

import pytest
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from tests.benchmarks.full_scale import flops
from tests.support.micro_model import micro, random_clips, random_tokens, with_adapter
from tests.support.micro_runs import MICRO

TOKENS = 12


@pytest.fixture(params=[("2b", 2), ("5b", 1), ("1.5-5b", 3)], ids=str)
def backbone(request):
    """A micro model with the positions and patches of a published one; four layers, a memory block after every n-th."""
    name, every = request.param
    settings = {"num_layers": 4, "use_rotary_positional_embeddings": name != "2b"}
    settings |= {"patch_size_t": 2, "patch_bias": False} if name == "1.5-5b" else {}
    return with_adapter(micro(transformer=MICRO["transformer"] | settings), every=every, positions="absolute")


def counted(backbone, stage, tokens):
    """FLOPs of the transformer's forward pass and of all of it with backward, by torch."""
    clips = random_clips(2, tokens)
    backbone.use_adapter("voxel" if tokens is not None else None)
    backbone.trained_parameters(stage)
    latents = backbone.shape.pad(backbone.codec.encode(clips.rgb, clips.depth))
    conditions, image = backbone.conditions(clips, torch.full((2,), 500)), backbone.encode_first(clips)
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        memory = backbone.memory_condition(clips)
        predicted = backbone.predict(latents, image, dataclasses.replace(conditions, memory=memory))
        forward = counter.get_total_flops()
        predicted.square().mean().backward()
    return forward, counter.get_total_flops()


def test_the_formulas_of_stage_one_give_the_flops_that_torch_counts(backbone):
    video = flops.video_sizes(backbone, 2)
    forward, step = counted(backbone, "1", None)
    assert forward == flops.forward(video)
    assert step == flops.stage1_step(video)


def test_the_formulas_of_stage_two_give_the_flops_that_torch_counts(backbone):
    video, memory = flops.video_sizes(backbone, 2), flops.memory_sizes(backbone, TOKENS)
    forward, step = counted(backbone, "2", random_tokens(2, TOKENS))
    assert forward == flops.forward(video, memory)
    assert step == flops.stage2_step(video, memory)
