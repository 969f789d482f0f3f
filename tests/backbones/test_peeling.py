"""Depth peeling: which surfaces lie behind each pixel, and what the form ``rendered`` makes of them."""

import dataclasses

import pytest
import torch

from persist_backbones.adapters.peeling import VALUES, LayerEmbedding, peel
from persist_backbones.adapters.rendered import RenderedSettings, render_views
from persist_backbones.adapters.splat import Splats, coarser
from persist_cli.api.observations import Origin
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import CheckpointError
from tests.support.micro_model import CHANNELS, micro, predicted, random_clips, random_tokens, shaken, with_adapter

POINTS = RenderedSettings(token_size=0.001, splat_pixels=1, supersampling=1)
LAYERS = {"form": "rendered", "layers": 2, "classes": 4, "attention_tokens": 0}


def in_line(depths, classes=None, origins=None):
    """Tokens of one sample straight ahead of the first camera, each of a colour of its own."""
    count = len(depths)
    places = torch.tensor([[0.01, 0.01, depth] for depth in depths], dtype=torch.float64)
    features = torch.eye(CHANNELS)[classes or [0] * count]
    colors = torch.arange(1, count + 1)[:, None].expand(-1, 3).to(torch.uint8) * 51
    return MemoryTokens.stack([MemoryTokens.of(features, places, colors, origins)])


def surfaces(tokens, layers=2, gap=0.3, classes=4):
    """The surfaces behind the middle of the first frame, at an eighth of its size."""
    cameras = random_clips(1).cameras
    views = render_views(tokens, cameras, POINTS)
    size = (cameras.height, cameras.width)
    coarse = (cameras.height // 8, cameras.width // 8)
    splats = coarser(views.splats, size, coarse)
    drawn = peel(tokens, splats, (1, views.depth.shape[1], *coarse), layers, gap, classes)
    return drawn[0, 0, :, :, coarse[0] // 2, coarse[1] // 2]


def test_layers_are_the_surfaces_one_behind_the_other_with_class_colour_and_depth():
    near, far = surfaces(in_line([5.0, 3.0], classes=[2, 1]))
    assert near.tolist() == pytest.approx([2, 0.4, 0.4, 0.4, torch.tensor(3.0).log2().item(), 1])
    assert far.tolist() == pytest.approx([3, 0.2, 0.2, 0.2, torch.tensor(5.0).log2().item(), 1])


def test_what_lies_closer_than_the_gap_is_one_surface_of_the_class_of_most():
    near, far = surfaces(in_line([3.0, 3.1, 3.2, 4.0], classes=[0, 3, 3, 1]))
    assert near[0] == 4
    assert near[1].item() == pytest.approx(0.4)  # of 0.2, 0.4 and 0.6
    assert far[0] == 2


def test_a_ray_that_meets_fewer_surfaces_has_zeros_for_the_others():
    assert not surfaces(in_line([3.0]), layers=3)[1:].any()


def test_layers_tell_what_was_imagined():
    origins = torch.tensor([Origin.OBSERVED, Origin.IMAGINED], dtype=torch.uint8)
    assert surfaces(in_line([3.0, 5.0], origins=origins))[:, 5].tolist() == [1, 0]


def test_the_order_of_tokens_does_not_matter():
    one = surfaces(in_line([3.0, 5.0], classes=[1, 2]))
    tokens = in_line([3.0, 5.0], classes=[1, 2])
    flipped = MemoryTokens(**{name: part.flip(1) for name, part in tokens.tensors().items()})
    assert torch.equal(surfaces(flipped), one)


@pytest.mark.parametrize("value", range(VALUES))
def test_the_embedding_tells_each_value_of_each_surface(value):
    torch.manual_seed(0)
    embedding = LayerEmbedding(layers=2, classes=4, class_channels=8, width=16)
    surfaces = torch.tensor([2.0, 0.2, 0.4, 0.6, 1.5, 1.0]).repeat(1, 2, 1)
    for layer in (0, 1):
        other = surfaces.clone()
        other[0, layer, value] -= 0.75 if value else 1.0
        assert not torch.allclose(embedding(other), embedding(surfaces), atol=1e-4)


def test_a_coarser_pixel_has_the_splats_of_its_own_part_of_a_wide_image():
    pixels = torch.arange(2 * 4 * 8)
    drawn = coarser(Splats(pixels, 0 * pixels, pixels.double()), (4, 8), (2, 4)).pixel
    frame, row, column = pixels // 32, pixels % 32 // 8, pixels % 8
    assert torch.equal(drawn, (2 * frame + row // 2) * 4 + column // 2)


def test_nothing_embeds_to_zero_and_another_class_to_something_else():
    torch.manual_seed(0)
    embedding = LayerEmbedding(2, 4, 8, 16)
    nothing, wall, door = torch.zeros(3, 2, 6).unbind(0)
    wall[0], door[0] = torch.tensor([1.0, 0.5, 0.5, 0.5, 1.6, 1.0]), torch.tensor([2.0, 0.5, 0.5, 0.5, 1.6, 1.0])
    empty, one, other = embedding(torch.stack([nothing, wall, door]))
    assert not empty.any()
    assert not torch.allclose(one, other)


def test_a_fresh_adapter_with_layers_predicts_what_one_without_them_does():
    clips, tokens = random_clips(), random_tokens(2, 60)
    plain = with_adapter(micro(), form="rendered", attention_tokens=0)
    assert torch.equal(predicted(with_adapter(micro(), **LAYERS), clips, tokens), predicted(plain, clips, tokens))


def test_without_tokens_an_adapter_with_layers_equals_stage_one_to_the_bit_even_after_training():
    backbone, clips = micro(), random_clips()
    shaken(backbone)
    bare = predicted(backbone, clips, None)
    with_adapter(backbone, **LAYERS)
    shaken(backbone.adapters)
    assert torch.equal(predicted(backbone, clips, None), bare)


def test_a_trained_adapter_sees_the_class_of_what_is_hidden():
    backbone, clips = with_adapter(micro(), **LAYERS), random_clips(1)
    shaken(backbone)
    one, other = in_line([3.0, 6.0], classes=[1, 2]), in_line([3.0, 6.0], classes=[1, 3])
    assert not torch.equal(predicted(backbone, clips, one), predicted(backbone, clips, other))
    without = with_adapter(micro(), **LAYERS | {"layers": 1})
    shaken(without)
    assert torch.equal(predicted(without, clips, one), predicted(without, clips, other))


def test_what_is_embedded_of_kept_layers_are_the_surfaces_of_each_pixel(monkeypatch):
    adapter, clips, read = with_adapter(micro(), **LAYERS, token_size=0.2).adapter, random_clips(1), []

    def recorded(pixels):
        read.append(pixels)
        return pixels.new_zeros(len(pixels), adapter.settings.layer_width)

    monkeypatch.setattr(adapter.layers, "forward", recorded)
    tokens = in_line([2.5, 6.0], classes=[1, 3])
    adapter.prepare(adapter.render(tokens, clips.cameras, lambda *_: torch.zeros(1, 3, 8, 8, 8)), clips.cameras)
    shown = {
        tuple(surface) for surface in read[0].reshape(-1, 12).double().round(decimals=2).tolist() if surface[6] > 0
    }
    assert {(one[:4], one[6:10]) for one in shown} == {((2.0, 0.2, 0.2, 0.2), (4.0, 0.4, 0.4, 0.4))}
    assert {(one[5], one[11]) for one in shown} == {(1.0, 1.0)}  # both were observed
    assert {round(2 ** one[10] - 2 ** one[4], 1) for one in shown} == {3.5}


def test_training_reaches_the_embedding_of_classes():
    backbone, clips = with_adapter(micro(), **LAYERS), random_clips()
    shaken(backbone.adapters)
    backbone(dataclasses.replace(clips, tokens=random_tokens(2, 60)), "2")["loss"].backward()
    assert backbone.adapter.layers.classes.weight.grad.any()
    assert backbone.adapter.layers.reduce.weight.grad.any()


def test_layers_that_are_kept_stand_for_the_tokens_they_were_peeled_from():
    backbone, clips, tokens = with_adapter(micro(), **LAYERS), random_clips(), random_tokens(2, 60)
    shaken(backbone)
    kept = backbone.keep_tokens(dataclasses.replace(clips, tokens=tokens))
    assert torch.equal(predicted(backbone, clips, kept), predicted(backbone, clips, tokens))
    assert len({with_adapter(micro(), **LAYERS | change).token_encoding() for change in ({}, {"layer_gap": 0.2})}) == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [({"classes": 40}, "classes is 40, but a token has 6"), ({"layer_scale": 3}, "layer_scale is 3; it must divide")],
)
def test_layers_that_do_not_fit_are_refused_in_one_line(change, message):
    with pytest.raises(CheckpointError, match=message):
        with_adapter(micro(), **LAYERS | change)
