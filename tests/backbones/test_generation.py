"""From a first frame to a clip: conditions, seeds, saving, and the losses of the stages."""

import dataclasses
import math

import pytest
import torch

from persist_backbones.cogvideox.codec import decode_depth, encode_depth, fill_missing
from persist_backbones.cogvideox.diffusion import loss_weights
from persist_backbones.cogvideox.inputs import camera_latents, camera_tokens, interaction_rows, model_input
from persist_cli.api.backbone import Backbone, Sampling
from persist_cli.errors import CheckpointError, DataError, PersistError
from tests.support.micro_model import micro, random_clips, shaken


def test_depth_from_centimetres_to_a_hall_survives_its_code():
    depth = torch.tensor([0.1, 0.3, 1.0, 5.0, 20.0, 64.0])
    assert torch.allclose(decode_depth(encode_depth(depth)), depth, rtol=1e-4)
    assert decode_depth(encode_depth(torch.zeros(1))).item() == 0


def test_filling_missing_depth_keeps_measured_values_and_leaves_no_hole():
    depth = torch.full((1, 13, 17), 3.0)
    depth[:, 4:9, 3:12] = 0
    filled = fill_missing(depth)
    assert torch.allclose(filled, torch.full_like(depth, 3.0))
    assert not fill_missing(torch.zeros(1, 4, 4)).any()


def test_nine_frames_of_rays_become_three_latent_frames_of_24_channels():
    assert camera_latents(random_clips(1).cameras, 4, 4, False).shape == (1, 3, 24, 8, 8)


def test_a_latent_pixel_has_the_rays_through_its_middle_of_the_frames_it_stands_for():
    rays = camera_latents(random_clips(1, size=(9, 16, 32)).cameras, 4, 4, False)[0].unflatten(1, (4, 6))
    focal, row, column = 32 * 0.7, 1, 6  # of a wide image, whose cameras look ahead
    x, y = (4 * column + 2 - 16) / focal, (4 * row + 2 - 8) / focal
    for latent, frames in enumerate([(0, 0, 0, 0), (1, 2, 3, 4), (5, 6, 7, 8)]):
        ahead = 0.25 * torch.tensor(frames)
        expected = torch.stack([-y * ahead, x * ahead, 0 * ahead, *(torch.full((4,), d) for d in (x, y, 1.0))], dim=1)
        torch.testing.assert_close(rays[latent, :, :, row, column], expected)


def test_a_video_token_has_the_mean_of_the_camera_over_its_patch():
    latents = torch.arange(2 * 4 * 6.0).reshape(1, 2, 1, 4, 6)  # of frames, rows and columns
    tokens = camera_tokens(latents, 2)
    assert tokens[0, :, 0].tolist() == [24 * frame + 12 * row + 2 * c + 3.5 for frame in (0, 1) for row in (0, 1)
                                        for c in (0, 1, 2)]  # fmt: skip
    folded = camera_tokens(latents, 2, frames=2)
    assert folded[0, 1].tolist() == [5.5, 29.5]  # of both frames


@pytest.mark.parametrize("depth", [True, False])
def test_the_model_takes_colour_and_its_image_then_depth_and_its_image_then_the_camera(depth):
    noisy, image, camera = torch.tensor([1.0, 2.0]), torch.tensor([3.0, 4.0]), torch.tensor([5.0])
    taken = model_input(*(part[None, None, :, None, None] for part in (noisy, image, camera)), depth)
    assert taken.flatten().tolist() == ([1, 3, 2, 4, 5] if depth else [1, 3, 0, 0, 5])


@pytest.mark.parametrize("sampler", ["ddim", "dpm"])
def test_a_clip_depends_on_its_seed_and_not_on_its_batch(sampler):
    backbone, clips, sampling = micro(), random_clips(2), Sampling(3, sampler)
    shaken(backbone)
    rgb, depth = backbone.generate(clips, sampling)
    repeated = backbone.generate(clips, sampling)
    assert torch.equal(rgb, repeated[0])
    assert torch.equal(depth, repeated[1])
    second = dataclasses.replace(random_clips(2), rgb=clips.rgb[1:], depth=clips.depth[1:], seeds=[1])
    second = dataclasses.replace(
        second, cameras=dataclasses.replace(clips.cameras, world_from_camera=clips.cameras.world_from_camera[1:],
                                            intrinsics=clips.cameras.intrinsics[1:]), interactions=[(None,) * 8]
    )  # fmt: skip
    alone = backbone.generate(second, sampling)
    assert (alone[0][0].int() - rgb[1].int()).abs().max() <= 1
    reseeded = backbone.generate(dataclasses.replace(clips, seeds=[7, 8]), sampling)
    assert not torch.equal(rgb, reseeded[0])


def test_a_clip_begins_with_the_given_frame():
    backbone, clips = micro(), random_clips(1)
    rgb, depth = backbone.generate(clips, Sampling(1))
    assert torch.equal(rgb[:, 0], clips.rgb[:, 0])
    assert torch.equal(depth[:, 0], clips.depth[:, 0])
    assert rgb.shape == clips.rgb.shape


def test_a_model_survives_saving_to_the_bit(tmp_path):
    backbone, clips = micro(), random_clips(1)
    shaken(backbone)
    backbone.save_base(tmp_path)
    loaded = micro()
    loaded.load_base(tmp_path)
    outputs = zip(backbone.generate(clips, Sampling(2)), loaded.generate(clips, Sampling(2)), strict=True)
    assert all(torch.equal(before, after) for before, after in outputs)


def test_interactions_change_the_loss_only_once_their_embedding_is_trained():
    backbone = micro()
    shaken(backbone.transformer.base)
    picked = random_clips(1, interactions=[(None, "pick_up", *[None] * 6)])
    dropped = random_clips(1, interactions=[(None, "drop", *[None] * 6)])
    assert torch.equal(backbone(picked, "1")["loss"], backbone(random_clips(1), "1")["loss"])
    torch.nn.init.normal_(backbone.transformer.interactions.weight)
    assert not torch.equal(backbone(picked, "1")["loss"], backbone(dropped, "1")["loss"])


def test_an_unknown_interaction_sampler_or_window_is_refused():
    backbone = micro()
    with pytest.raises(DataError, match="no interaction 'jump'; it has pick_up, drop, toggle"):
        backbone(random_clips(1, interactions=[("jump",) * 8]), "1")
    with pytest.raises(PersistError, match="unknown sampler 'euler'; known: ddim, dpm"):
        backbone.generate(random_clips(1), Sampling(1, "euler"))
    with pytest.raises(CheckpointError, match="larger than the clips"):
        micro(codec_window=[9, 64, 64])(random_clips(1), "codec")


def test_a_loss_depends_on_the_seeds_alone():
    backbone, clips = micro(), random_clips(2)
    for stage in ("codec", "1"):
        assert torch.equal(backbone(clips, stage)["loss"], backbone(clips, stage)["loss"])
        reseeded = dataclasses.replace(clips, seeds=[5, 6])
        assert not torch.equal(backbone(clips, stage)["loss"], backbone(reseeded, stage)["loss"])


def test_min_snr_lowers_the_weight_of_clean_samples_and_never_exceeds_one():
    scheduler = micro().scheduler
    weights = loss_weights(scheduler, torch.tensor([0, 300, 999]), "min-snr", 5.0)
    signal = scheduler.alphas_cumprod[torch.tensor([0, 300, 999])].double()
    snr = signal / (1 - signal)
    assert torch.allclose(weights.double(), snr.clamp_max(5.0) / (snr + 1), atol=1e-6)
    assert loss_weights(scheduler, torch.tensor([0, 999]), "uniform", 5.0).tolist() == [1.0, 1.0]
    assert float(loss_weights(scheduler, torch.tensor([999]), "min-snr-plus-one", 5.0)) == pytest.approx(1.0)


def test_min_snr_plus_one_caps_the_weight_of_clean_samples_at_gamma():
    scheduler, steps = micro(prediction="sample").scheduler, torch.tensor([0, 999])
    assert loss_weights(scheduler, steps, "min-snr-plus-one", 5.0).tolist() == pytest.approx([5.0, 1.0])


def test_an_interaction_has_an_embedding_for_each_step_of_a_clip():
    clips = [("pick_up", None, "drop"), (None, "drop", "pick_up")]
    assert interaction_rows(clips, ("pick_up", "drop"), 3).tolist() == [[1, 0, 6], [0, 4, 5]]


def test_the_codec_stage_measures_the_scale_of_its_latents():
    backbone, clips = micro(), random_clips(2)
    backbone.finish_stage("codec", [clips])
    assert float(backbone.codec.encode(clips.rgb, clips.depth).detach().std()) == pytest.approx(1.0, abs=0.01)


def test_the_scale_of_latents_is_the_mean_over_batches_and_measuring_it_again_changes_nothing():
    backbone, bright = micro(), random_clips(2)
    dark = dataclasses.replace(bright, rgb=bright.rgb // 4)
    scales = [backbone.codec.measure_scale(clips.rgb, clips.depth) for clips in (bright, dark)]
    assert scales[0] != pytest.approx(scales[1], rel=0.01)
    for _ in range(2):
        backbone.finish_stage("codec", [bright, dark])
        assert backbone.codec.vae.config.scaling_factor == pytest.approx(sum(scales) / 2, rel=1e-4)


def with_posterior(deviation, **settings):
    """A micro model whose codec has latents of this standard deviation, whatever it codes."""
    backbone = micro(**settings)
    last = backbone.codec.vae.encoder.conv_out.conv
    with torch.no_grad():
        last.weight[backbone.codec.channels :] = 0.0
        last.bias[backbone.codec.channels :] = 2 * math.log(deviation)
    return backbone


def test_the_psnr_of_the_codec_stage_is_that_of_the_colours():
    backbone, clips = with_posterior(1e-6), random_clips(2)
    decoded, _ = backbone.codec.decode_images(backbone.codec.encode(clips.rgb, clips.depth))
    error = (decoded - (clips.rgb.movedim(-1, 1) / 127.5 - 1)) / 2
    assert backbone(clips, "codec")["psnr"].item() == pytest.approx(
        -10 * error.square().mean().log10().item(), abs=1e-2
    )


def test_the_codec_learns_from_latents_with_the_noise_of_their_posterior_and_from_its_prior(monkeypatch):
    clips, decoded, losses = random_clips(2), [], []
    for weight in (0.0, 0.5):
        codec = with_posterior(0.3, kl_weight=weight)
        images_of = codec.codec.images_of
        monkeypatch.setattr(
            codec.codec, "images_of", lambda latents, of=images_of: decoded.append(latents) or of(latents)
        )
        losses.append(codec(clips, "codec"))
    mean = codec.codec.posterior(codec.codec.images(clips.rgb, clips.depth)).mean
    assert (decoded[0] - mean).std().item() == pytest.approx(0.3, rel=0.05)
    assert (losses[1]["loss"] - losses[0]["loss"]).item() == pytest.approx(0.5 * losses[0]["kl"].item(), rel=1e-3)


def test_a_codec_that_trains_its_decoder_leaves_latents_and_their_scale_as_they_are():
    backbone, clips = micro(codec_trains="decoder"), random_clips(2)
    scale, trained = backbone.codec.vae.config.scaling_factor, backbone.trained_parameters("codec")
    assert all(name.startswith("codec.vae.decoder.") for name in trained)
    assert len(trained) == len([*backbone.codec.vae.decoder.parameters()])
    backbone.finish_stage("codec", [clips])
    assert backbone.codec.vae.config.scaling_factor == scale


def test_rays_as_printed_in_the_paper_change_the_model_input():
    correct, printed = (
        micro(rays=rays).conditions(random_clips(1), torch.tensor([0])).camera for rays in ("correct", "printed")
    )
    assert not torch.equal(correct, printed)


@pytest.mark.parametrize(
    ("sampling", "cause"),
    [
        (Sampling(4, "euler"), r"^unknown sampler 'euler'; known: ddim, dpm, unipc, dpm\+\+, consistency$"),
        (Sampling(0), "^0 denoising steps; it must be at least 1$"),
        (Sampling(memory_guidance=-1.0), "^guidance over memory of -1.0; it must be a number of at least 0$"),
        (Sampling(memory_guidance=float("inf")), "^guidance over memory of inf; it must be"),
        (Sampling(1001), "^1001 denoising steps; it must be 1 to 1000$"),
    ],
)
def test_an_impossible_sampling_is_refused_by_the_check_and_by_generate(sampling, cause):
    backbone = micro()
    for attempt in (lambda: backbone.check_sampling(sampling), lambda: backbone.generate(random_clips(1), sampling)):
        with pytest.raises(PersistError, match=cause):
            attempt()
    for sampler in backbone.samplers:
        backbone.check_sampling(Sampling(1000, sampler))
        backbone.check_sampling(Sampling(501, sampler))


def test_by_default_a_backbone_gives_depth_and_encodes_nothing():
    backbone = micro(depth=False)
    for attempt in (lambda: Backbone.encode(backbone, random_clips(1)), lambda: Backbone.encoding(backbone)):
        with pytest.raises(NotImplementedError, match="backbone 'cogvideox' keeps nothing of a clip"):
            attempt()
    assert Backbone.gives_depth.fget(backbone)
    assert not Backbone.encodes(backbone, "1")
    for sampling, cause in ((Sampling(0), "0 denoising steps"), (Sampling(1, "euler"), "unknown sampler 'euler'")):
        with pytest.raises(PersistError, match=cause):
            Backbone.check_sampling(backbone, sampling)
