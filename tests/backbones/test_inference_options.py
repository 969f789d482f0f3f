"""A backbone prepared for inference generates the same clips, wherever its weights are between clips."""

from __future__ import annotations

import pytest
import torch

from persist_backbones.extensions.inference import prepare_inference, tile_overlap
from persist_cli.api.backbone import Sampling
from persist_cli.api.inference import InferenceOptions
from persist_cli.errors import PersistError
from tests.support.micro_model import equal, random_clips, random_tokens, trained, with_adapter

CLIPS, SAMPLING = random_clips(2, random_tokens(2, 5)), Sampling(2, "ddim", 1.5)

CPU = torch.device("cpu")


def test_slices_of_the_codec_change_no_colour_and_are_undone_by_other_options():
    backbone = trained()
    rgb, depth = backbone.generate(CLIPS, SAMPLING)
    backbone.prepare_inference(InferenceOptions(slicing=True, tiling=True))
    assert backbone.codec.vae.use_slicing
    assert backbone.codec.vae.use_tiling
    backbone.prepare_inference(InferenceOptions(slicing=True))
    sliced = backbone.generate(CLIPS, SAMPLING)
    assert (sliced[0].int() - rgb.int()).abs().max() <= 1
    assert torch.allclose(sliced[1], depth, rtol=1e-3)
    backbone.prepare_inference(InferenceOptions())
    assert not backbone.codec.vae.use_slicing
    assert equal(backbone.generate(CLIPS, SAMPLING), (rgb, depth))


def test_a_backbone_in_lower_precision_stays_so_and_samples_nearly_the_same():
    backbone, clips = trained(), random_clips(1, random_tokens(1, 5))
    rgb, _ = backbone.generate(clips, SAMPLING)
    backbone.prepare_inference(InferenceOptions(dtype="bfloat16"))
    assert {parameter.dtype for parameter in backbone.parameters()} == {torch.bfloat16}
    coarse, depth = backbone.generate(clips, SAMPLING)
    assert (coarse.dtype, depth.dtype) == (torch.uint8, torch.float32)
    assert 0 < (coarse.float() - rgb.float()).abs().mean() < 0.05 * 255
    assert backbone.reconstruct(clips)[0].dtype == torch.uint8


def test_offloading_whole_parts_changes_no_clip_even_after_another_adapter():
    backbone = trained()
    before = backbone.generate(CLIPS, SAMPLING)
    for _ in range(2):
        backbone.offloaded = prepare_inference(backbone, backbone.offloaded, InferenceOptions(offload="model"), CPU)
        assert equal(backbone.generate(CLIPS, SAMPLING), before)
        assert equal(backbone.generate(CLIPS, SAMPLING), before)
    with_adapter(backbone, form="canvas")
    backbone.offloaded = prepare_inference(backbone, backbone.offloaded, InferenceOptions(offload="model"), CPU)
    backbone.generate(CLIPS, SAMPLING)
    backbone.use_adapter("voxel")
    backbone.prepare_inference(InferenceOptions())
    assert backbone.offloaded is None
    assert not any(hasattr(module, "_hf_hook") for module in backbone.modules())


@pytest.mark.gpu
@pytest.mark.parametrize("offload", ["model", "sequential"])
def test_an_offloaded_backbone_leaves_the_gpu_empty_between_clips(offload):
    backbone = trained()
    backbone.prepare_inference(InferenceOptions())
    rgb, _ = backbone.generate(CLIPS, SAMPLING)
    for _ in range(2):
        backbone.prepare_inference(InferenceOptions(offload=offload))
        offloaded, _ = backbone.generate(CLIPS, SAMPLING)
        assert (offloaded.int() - rgb.int()).abs().max() <= 2
    assert backbone.transformer.base.device.type != "cuda"
    backbone.prepare_inference(InferenceOptions())
    assert backbone.transformer.base.device.type == "cuda"


@pytest.mark.gpu
def test_a_guide_leaves_the_gpu_with_the_weights_that_are_offloaded(tmp_path):
    backbone = trained()
    backbone.save_base(tmp_path)
    backbone.guide_folder = tmp_path
    backbone.prepare_inference(InferenceOptions(offload="model"))
    backbone.generate(CLIPS, Sampling(2, autoguidance=2.0))
    assert backbone.guides[tmp_path].transformer.base.device.type == "cpu"


@pytest.mark.parametrize("scale", [1, 4, 8])
def test_tiles_overlap_by_whole_latent_pixels(scale):
    for tile in range(2, 120):
        share = tile_overlap(tile, scale)
        blend, step = int(tile * share), int(tile * scale * (1 - share))
        assert step == scale * (tile - blend)
        assert 0 < blend < tile
    with pytest.raises(PersistError, match=r"tiles of 1 latent pixels are too small to overlap; leave it out$"):
        tile_overlap(1, scale)
