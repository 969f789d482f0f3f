"""Clips that are shorter than those of training: what they share with whole ones, and which lengths there are."""

import dataclasses

import pytest
import torch

from persist_cli.api.backbone import Sampling
from persist_cli.errors import PersistError
from tests.support.micro_model import FRAMEWISE, POINT_FORMS, micro, random_clips, random_tokens, shaken, trained
from tests.support.twins import load_twin, write_twin


@pytest.mark.parametrize("form", POINT_FORMS)
@pytest.mark.parametrize("frames", [2, 5])
def test_a_shorter_clip_has_as_many_frames_as_cameras_with_every_form_of_adapter(form, frames):
    backbone = trained(form, **FRAMEWISE)
    clips = random_clips(2, random_tokens(2, 9)).shortened(frames)
    rgb, depth = backbone.generate(clips, Sampling(2, memory_guidance=1.5))
    assert rgb.shape[:2] == depth.shape[:2] == (2, frames)
    assert torch.equal(rgb[:, 0], clips.rgb[:, 0])
    assert depth[:, 1:].std() > 0
    chosen, _ = backbone.generate_frame(clips, Sampling(2, memory_guidance=1.5), [frames - 1] * 2)
    # decoded beside other frames, a value may lie on the other side of a rounding
    assert (chosen.int() - rgb[:, -1].int()).abs().max() <= 1


def test_positions_of_a_shorter_clip_are_the_first_of_a_whole_one(tmp_path):
    for model in (micro(), load_twin(write_twin("5b-i2v", tmp_path / "twin"))):
        table, size = model.transformer.base.patch_embed, (model.shape.height, model.shape.width)
        short = table._get_positional_embeddings(*size, 1, device=torch.device("cpu"))
        assert torch.equal(short, table.pos_embedding[:, : short.shape[1]])
        assert short.shape[1] < table.pos_embedding.shape[1]


def test_the_sinusoidal_positions_of_a_shorter_clip_are_those_of_diffusers():
    table = micro(**FRAMEWISE).transformer.base.patch_embed
    mine = table._get_positional_embeddings(8, 8, 5)
    theirs = super(type(table), table)._get_positional_embeddings(8, 8, 5)
    assert torch.allclose(mine, theirs)


def test_a_shortened_clip_keeps_the_latents_and_views_of_its_frames():
    for settings, frames in (({}, 3), (FRAMEWISE, 9)):
        backbone, clips = trained("rendered", **settings), random_clips(2, random_tokens(2, 9))
        clips = dataclasses.replace(clips, latents=backbone.encode(clips), tokens=backbone.keep_tokens(clips))
        short = clips.shortened(5)
        count = (frames + 1) // 2
        assert torch.equal(short.latents.video, clips.latents.video[:, :count])
        assert torch.equal(short.tokens.rendered, clips.tokens.rendered[:, :count])
        assert [len(names) for names in short.interactions] == [4, 4]
        assert short.cameras.world_from_camera.shape[1] == short.rgb.shape[1] == short.depth.shape[1] == 5


def test_a_shorter_clip_can_be_trained_on():
    backbone = micro(**FRAMEWISE)
    losses = backbone(random_clips(2).shortened(3), "1")
    assert torch.isfinite(losses["loss"])


def test_a_codec_that_folds_time_makes_clips_of_some_lengths_only():
    backbone = micro(frames=17)
    shaken(backbone)
    clips = random_clips(1, size=(17, 32, 32)).shortened(9)
    assert backbone.generate(clips, Sampling(1))[0].shape[1] == 9
    backbone.check_clip_frames(9)
    for frames in (1, 2, 8, 18, 25):
        with pytest.raises(PersistError, match=f"^clips of {frames} frames, .* this model makes clips of 9, 17 frames"):
            backbone.check_clip_frames(frames)


def test_a_codec_that_codes_every_frame_alone_makes_clips_of_any_shorter_length():
    backbone = micro(**FRAMEWISE)
    for frames in range(2, 10):
        backbone.check_clip_frames(frames)
    for frames in (0, 1, 10):
        with pytest.raises(PersistError, match="makes clips of 2 to 9 frames"):
            backbone.check_clip_frames(frames)
