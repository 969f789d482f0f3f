"""The form ``rendered``: what is drawn, what goes through the codec, and how it moves the prediction."""

import dataclasses
import json

import pytest
import torch

from persist_backbones.adapters.rendered import RenderedAdapter, RenderedSettings, render_views, tokens_not_shown
from persist_backbones.cogvideox.diffusion import noise_level
from persist_backbones.tensors import push_pull
from persist_cli.api.backbone import Sampling
from persist_cli.api.cameras import Cameras
from persist_cli.api.geometry import unproject
from persist_cli.api.observations import Origin
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import CheckpointError
from tests.support.micro_model import (
    CHANNELS,
    micro,
    predicted,
    predicted_of,
    random_clips,
    random_tokens,
    shaken,
    with_adapter,
)
from tests.support.micro_runs import MICRO, SIZE

WIDE = {"token_size": 40.0, "splat_pixels": 199}  # a token that fills every view
POINTS = RenderedSettings(token_size=0.001, splat_pixels=1, supersampling=1, hole_share=0.0)


def own_pixels(clips):
    """Tokens at the points that the pixels of the clips' first frames show."""
    first = Cameras(clips.cameras.world_from_camera[:, 0], clips.cameras.intrinsics[:, 0], SIZE, SIZE)
    points = unproject(clips.depth[:, 0], first).flatten(1, 2)
    mask = torch.ones(points.shape[:2], dtype=torch.bool)
    return MemoryTokens(torch.zeros(*mask.shape, CHANNELS), points, mask, clips.rgb[:, 0].flatten(1, 2))


def wall(depth=3.0):
    """One token ahead of the cameras, in two samples."""
    place = torch.tensor([0.0, 0.0, depth], dtype=torch.float64).expand(2, 1, 3)
    colors = torch.full((2, 1, 3), 200, dtype=torch.uint8)
    return MemoryTokens(torch.ones(2, 1, CHANNELS), place, torch.ones(2, 1, dtype=torch.bool), colors)


def clean_of(backbone, clips, tokens, timestep):
    """The clean latents as predicted, and those that the adapter rendered."""
    condition = backbone.memory_condition(dataclasses.replace(clips, tokens=tokens))
    noisy = torch.randn(2, 3, 8, 8, 8, generator=torch.Generator().manual_seed(4))
    timesteps = torch.full((2,), timestep)
    conditions = backbone.conditions(clips, timesteps, condition)
    result = backbone.predict(noisy, backbone.encode_first(clips), conditions)
    return noise_level(backbone.scheduler, timesteps).clean(result, noisy), condition.memory


def test_pixels_of_a_frame_are_drawn_back_to_where_they_were():
    clips = random_clips()
    views = render_views(own_pixels(clips), clips.cameras, POINTS)
    assert views.covered[:, 0, 0].all()
    assert torch.equal(views.rgb[:, 0], clips.rgb[:, 0])
    assert torch.allclose(views.depth[:, 0], clips.depth[:, 0], rtol=1e-4)


def test_an_antialiased_pixel_is_the_mean_of_what_is_drawn_in_it_and_covered_by_its_share():
    clips = random_clips()
    pixel = torch.tensor([[20.25, 12.25, 1.0], [20.75, 12.25, 1.0]], dtype=torch.float64)  # two quarters of a pixel
    place = 3 * pixel @ torch.linalg.inv(clips.cameras.intrinsics[0, 0]).T
    colors = torch.tensor([[100, 0, 0], [200, 0, 0]], dtype=torch.uint8).expand(2, 2, 3)
    tokens = MemoryTokens(torch.zeros(2, 2, CHANNELS), place.expand(2, 2, 3), torch.ones(2, 2).bool(), colors)
    views = render_views(tokens, clips.cameras, dataclasses.replace(POINTS, supersampling=2))
    assert views.rgb[0, 0, 12, 20].tolist() == [150, 0, 0]
    assert views.covered[0, 0, 0, 12, 20] == 0.5
    assert views.covered[0, 0].sum() == 0.5


def two_at_a_pixel(behind, distances=None):
    """Tokens of grey 100 and, some metres behind it, of grey 200."""
    place = torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, 3.0 + behind]], dtype=torch.float64).expand(2, 2, 3)
    colors = torch.tensor([[100] * 3, [200] * 3], dtype=torch.uint8).expand(2, 2, 3)
    tokens = MemoryTokens(torch.zeros(2, 2, CHANNELS), place, torch.ones(2, 2).bool(), colors)
    return tokens if distances is None else dataclasses.replace(tokens, distances=torch.tensor([distances] * 2))


@pytest.mark.parametrize(
    ("behind", "distances", "grey", "depth"),
    [(0.2, None, 100, 3.0), (0.04, None, 150, 3.02), (0.04, [1.0, 2.0], 120, 3.008), (0.2, [2.0, 0.0], 100, 3.0)],
    ids=["hidden", "one surface", "seen from twice as far", "hidden, though seen from nearer"],
)
def test_tokens_of_one_surface_are_drawn_as_their_mean_by_how_near_they_were_seen(behind, distances, grey, depth):
    clips = random_clips()
    views = render_views(two_at_a_pixel(behind, distances), clips.cameras, POINTS)
    assert (views.rgb[:, 0] == grey).all()
    assert torch.allclose(views.depth[:, 0], torch.tensor(depth))


def test_holes_are_filled_from_around_them_and_count_as_holes():
    clips = random_clips()
    views = render_views(wall(), clips.cameras, POINTS)
    assert views.covered.sum(dim=(1, 2, 3, 4)).tolist() == [9.0, 9.0]  # a pixel in each frame
    assert (views.rgb == 200).all()
    assert torch.allclose(views.depth[0, :, 0, 0], 3.0 - torch.arange(9) * 0.25)


def test_filling_keeps_what_is_known_and_fills_with_the_mean_of_the_nearest_scale():
    total, weight = torch.zeros(1, 1, 4, 4), torch.zeros(1, 1, 4, 4)
    total[..., 0, 0], total[..., 3, 3], weight[..., 0, 0], weight[..., 3, 3] = 1.0, 6.0, 1.0, 2.0
    filled = push_pull(total, weight)[0, 0]
    assert (filled[0, 0], filled[3, 3]) == (1.0, 3.0)
    assert 1.0 < filled[1, 2] < 3.0


@pytest.mark.parametrize("size", [(64, 64), (60, 90), (90, 60), (33, 45)])
def test_a_hole_is_filled_from_both_sides_in_images_of_any_size(size):
    ramp = (torch.arange(size[1]) + 0.5).expand(1, 1, *size)
    first = 2 * size[1] // 3
    weight = torch.ones(1, 1, *size)
    weight[..., first : first + 8] = 0.0
    error = (push_pull(ramp * weight, weight) - ramp)[..., first : first + 8]
    assert error.mean().abs() < 2.1  # of the 8 pixels that the hole is wide


def test_the_mask_tells_what_was_observed_from_what_was_imagined():
    tokens, clips = wall(), random_clips()
    tokens.origins[1] = Origin.IMAGINED
    adapter = with_adapter(micro(), form="rendered", **WIDE).adapter
    kept = adapter.render(tokens, clips.cameras, lambda rgb, depth: torch.zeros(2, 3, 8, 8, 8))
    mask = kept.rendered[:, :, 8:].unflatten(2, (4, 2))  # four frames, observed and imagined
    assert mask[0].unique().tolist() == mask[1].unique().tolist() == [0.0, 1.0]
    assert mask[0, :, :, 0].all()
    assert mask[1, :, :, 1].all()


def test_tokens_without_colours_are_refused_in_one_line():
    tokens = dataclasses.replace(random_tokens(2, 9), colors=None)
    with pytest.raises(CheckpointError, match="this memory's tokens have none; use the memory voxel"):
        predicted(with_adapter(micro(), form="rendered"), random_clips(), tokens)


@pytest.mark.parametrize("attention", [0, 8])
def test_views_that_show_nothing_equal_stage_one_to_the_bit_even_after_training(attention):
    backbone, clips, tokens = micro(), random_clips(), random_tokens(2, 60)
    shaken(backbone)
    bare = predicted(backbone, clips, None)
    with_adapter(backbone, form="rendered", attention_tokens=attention)
    shaken(backbone.adapters)
    remembered = backbone.memory_condition(dataclasses.replace(clips, tokens=tokens))
    assert torch.equal(predicted_of(backbone, clips, remembered.emptied()), bare)
    assert torch.equal(predicted(backbone, clips, None), bare)
    assert not torch.allclose(predicted_of(backbone, clips, remembered), bare, atol=1e-3)


@pytest.mark.parametrize("prediction", ["sample", "v_prediction"])
def test_a_fresh_adapter_predicts_from_noise_what_it_renders_and_nearly_leaves_what_is_hardly_noisy(prediction):
    backbone, clips = with_adapter(micro(prediction=prediction), form="rendered", **WIDE), random_clips()
    bare, _ = clean_of(backbone, clips, None, 999)
    clean, memory = clean_of(backbone, clips, wall(), 999)
    assert memory.share.min() == 1
    assert torch.allclose(clean, bare + (memory.latents - bare) * (64 / 65), atol=1e-3)
    bare, _ = clean_of(backbone, clips, None, 0)
    clean, memory = clean_of(backbone, clips, wall(), 0)
    assert (clean - bare).abs().max() < 0.1 * (memory.latents - bare).abs().max()


@pytest.mark.parametrize("prediction", ["sample", "v_prediction"])
def test_a_fresh_adapter_takes_the_weighted_mean_of_what_it_renders_and_what_is_predicted(prediction):
    errors = {"color_error": 0.05, "depth_error": 0.4}
    backbone, clips = with_adapter(micro(prediction=prediction), form="rendered", **WIDE, **errors), random_clips()
    bare, _ = clean_of(backbone, clips, None, 300)
    clean, memory = clean_of(backbone, clips, wall(), 300)
    level = noise_level(backbone.scheduler, torch.tensor([300]))
    snr = (level.signal / level.noise).square().item()
    gates = torch.tensor([1 / (1 + 1 / 64 + snr * error) for error in errors.values()]).repeat_interleave(4)
    assert torch.allclose(clean, bare + gates[:, None, None] * (memory.latents - bare), atol=1e-3)


def test_a_fresh_adapter_trusts_drawn_colours_less_the_larger_their_error_and_depth_as_before():
    clips = random_clips()
    sure, unsure = (with_adapter(micro(), form="rendered", **WIDE, color_error=error) for error in (0.05, 1.0))
    bare, _ = clean_of(sure, clips, None, 300)
    sure, unsure = (clean_of(backbone, clips, wall(), 300)[0] - bare for backbone in (sure, unsure))
    assert unsure[:, :, :4].abs().mean() < 0.6 * sure[:, :, :4].abs().mean()
    assert torch.equal(unsure[:, :, 4:], sure[:, :, 4:])


def test_a_clip_costs_one_encoding_more_than_without_memory_in_however_many_steps(monkeypatch):
    backbone, clips, encodings = micro(), random_clips(), []
    encode = backbone.codec.encode
    monkeypatch.setattr(backbone.codec, "encode", lambda *frames: encodings.append(frames) or encode(*frames))

    def encodings_of(steps):
        encodings.clear()
        backbone.generate(clips, Sampling(steps))
        return len(encodings)

    assert [encodings_of(1), encodings_of(4)] == [1, 1]
    with_adapter(backbone, form="rendered")
    clips = dataclasses.replace(clips, tokens=random_tokens(2, 60))
    assert [encodings_of(1), encodings_of(4)] == [2, 2]


def test_latents_that_are_kept_stand_for_the_tokens_they_were_rendered_from():
    backbone, clips, tokens = with_adapter(micro(), form="rendered"), random_clips(), random_tokens(2, 60)
    shaken(backbone)
    kept = backbone.keep_tokens(dataclasses.replace(clips, tokens=tokens))
    assert kept.rendered.dtype == torch.float16
    assert torch.equal(predicted(backbone, clips, kept), predicted(backbone, clips, tokens))
    again = MemoryTokens.stack([kept[0], kept[1]])
    assert torch.equal(predicted(backbone, clips, again), predicted(backbone, clips, kept))


def test_what_is_kept_of_tokens_depends_on_the_codec_and_on_how_they_are_drawn():
    texts = {with_adapter(micro(), form="rendered", **change).token_encoding() for change in ({}, {"token_size": 0.1})}
    backbone = with_adapter(micro(), form="rendered")
    shaken(backbone.codec)
    assert len(texts | {backbone.token_encoding()}) == 3
    assert with_adapter(micro(), form="canvas").token_encoding() == ""


@pytest.mark.parametrize(("layers", "changes"), [
    (0, [{"splat_pixels": 5}, {"hole_share": 0.0}, {"thickness": 0.1}, {"supersampling": 1}, {"attention_tokens": 8}]),
    (2, [{"layers": 3}, {"layer_gap": 0.1}, {"layer_scale": 1}, {"classes": 4}]),
])  # fmt: skip
def test_what_is_kept_of_tokens_depends_on_each_setting_of_their_drawing(layers, changes):
    video = micro().video_shape
    kept = [
        RenderedAdapter(CHANNELS, RenderedSettings(**{"layers": layers} | change), video).rendering()
        for change in ({}, *changes)
    ]
    assert len({json.dumps(settings, sort_keys=True) for settings in kept}) == 1 + len(changes)


def test_attention_reads_tokens_that_are_hidden_or_just_out_of_sight_and_no_others():
    clips = random_clips()
    places = [[0.0, 0.0, 3.0], [0.0, 0.0, 5.0], [0.0, 0.0, -1.0], [2.4, 0.0, 3.0], [9.0, 0.0, 3.0]]
    positions = torch.tensor(places, dtype=torch.float64).expand(2, -1, -1)
    mask = torch.ones(2, 5, dtype=torch.bool)
    tokens = MemoryTokens(torch.zeros(2, 5, CHANNELS), positions, mask, torch.zeros(2, 5, 3, dtype=torch.uint8))
    one = dataclasses.replace(clips.cameras, world_from_camera=clips.cameras.world_from_camera[:, :1],
                              intrinsics=clips.cameras.intrinsics[:, :1])  # fmt: skip
    shown = render_views(tokens, one, RenderedSettings(token_size=0.5)).shown
    assert shown[0].tolist() == [True, False, False, False, False]
    assert tokens_not_shown(tokens, shown, one, 4)[0].tolist() == [1, 3, -1, -1]
    adapter = with_adapter(micro(), form="rendered", token_size=0.5, attention_tokens=4).adapter
    kept = adapter.render(tokens, one, lambda rgb, depth: torch.zeros(2, 1, 8, 8, 8))
    assert kept.mask[0].tolist() == [True, True, False, False]
    assert kept.positions[0, :2].tolist() == [places[1], places[3]]


def test_a_larger_choice_of_hidden_tokens_is_spread_over_them():
    clips, tokens = random_clips(), wall().to("cpu")
    many = MemoryTokens(*(part.repeat_interleave(40, 1) for part in (tokens.features, tokens.positions, tokens.mask)))
    numbers = tokens_not_shown(many, torch.zeros_like(many.mask), clips.cameras, 4)
    assert numbers[0].tolist() == [0, 10, 20, 30]


def test_cogvideox_one_point_five_takes_rendered_views():
    rotary = {"patch_size_t": 2, "patch_bias": False, "use_rotary_positional_embeddings": True}
    transformer = MICRO["transformer"] | rotary
    backbone, clips, tokens = micro(transformer=transformer), random_clips(), random_tokens(2, 60)
    with_adapter(backbone, form="rendered")
    shaken(backbone)
    bare = predicted_with_padding(backbone, clips, None)
    assert not torch.allclose(predicted_with_padding(backbone, clips, tokens), bare, atol=1e-3)


@torch.no_grad()
def predicted_with_padding(backbone, clips, tokens):
    latents = backbone.shape.pad(backbone.codec.encode(clips.rgb, clips.depth))
    memory = backbone.memory_condition(dataclasses.replace(clips, tokens=tokens))
    conditions = backbone.conditions(clips, torch.full((2,), 500), memory)
    return backbone.predict(latents, backbone.encode_first(clips), conditions)


def test_noise_of_a_known_level_falls_on_latents_that_show_something_and_not_on_the_mask():
    backbone, clips, tokens = with_adapter(micro(), form="rendered", noise=0.5), random_clips(), random_tokens(2, 9)
    kept = backbone.keep_tokens(dataclasses.replace(clips, tokens=tokens))
    generators = [torch.Generator().manual_seed(seed) for seed in (1, 2)]
    noisy = backbone.adapter.noisy(kept, torch.tensor([0.0, 0.5]), generators).rendered
    mask = kept.rendered[:, :, 8:]
    assert torch.equal(noisy[:, :, 8:], mask)
    assert torch.equal(noisy[0], kept.rendered[0])
    change = (noisy - kept.rendered)[1, :, :8]
    covered = mask[1].any(dim=1, keepdim=True).expand_as(change)
    assert change[covered].float().std().item() == pytest.approx(0.5, abs=0.1)
    assert not change[~covered].any()
