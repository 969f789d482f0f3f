"""SRC and its motion guard on a turn there and back."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from persist_cli.api.geometry import pixel_centers
from persist_cli.io.files import write_json
from persist_cli.io.hub import cached_weight
from persist_cli.metrics import METRICS
from persist_cli.metrics.return_views import Match
from persist_cli.metrics.src import ENCODERS, farthest, patch_similarity
from tests.support.predictions import observe_room, setup, there_and_back
from tests.support.rooms import look

SRC, PATCH, AWAY = METRICS["src"], METRICS["src-patch"], METRICS["src-away"]
needs_encoder = pytest.mark.skipif(
    not any(cached_weight(encoder.name) for encoder in ENCODERS), reason="no weights of an encoder for SRC"
)


def cache_random_encoder(folder):
    """A random DINOv2 of nine blocks as a cached weight."""
    from transformers import Dinov2Config, Dinov2Model

    torch.manual_seed(0)
    sizes = {"hidden_size": 24, "num_hidden_layers": 9, "num_attention_heads": 2, "mlp_ratio": 2}
    Dinov2Model(Dinov2Config(image_size=56, patch_size=14, **sizes)).save_pretrained(folder)
    write_json(folder / "weight.json", {})


@pytest.fixture(params=[encoder.name for encoder in ENCODERS])
def encoder(request, tmp_path, monkeypatch):
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path))
    cache_random_encoder(tmp_path / "weights" / request.param)


def test_the_truth_has_100_at_returns_and_no_figure_elsewhere(encoder):
    figures = SRC.measure(there_and_back())
    assert figures[:4].isnan().all()
    assert figures[4:].tolist() == pytest.approx([100.0] * 3)
    assert figures[4:].max() <= 100


def test_a_place_that_looks_different_on_return_has_less(encoder):
    clip = there_and_back()
    changed = clip.rgb.clone()
    changed[5] = 255 - changed[5]
    figures = SRC.measure(replace(clip, rgb=changed))
    assert figures[5] < figures[4] == pytest.approx(100)


def test_patches_that_change_places_are_seen_patch_by_patch_and_not_in_their_mean(encoder):
    clip = there_and_back()
    assert PATCH.measure(clip)[4:].tolist() == pytest.approx([100.0] * 3)
    frozen = replace(clip, rgb=clip.rgb[:1].expand_as(clip.rgb))
    assert PATCH.measure(frozen)[4:].tolist() == pytest.approx([100.0] * 3)
    turned = clip.rgb.clone()
    turned[5] = turned[5].flip(0, 1)  # the same patches elsewhere, but for their own turn
    figures = replace(clip, rgb=turned)
    assert PATCH.measure(figures)[5] < SRC.measure(figures)[5]


def test_a_return_within_one_predicted_clip_asks_for_no_memory_and_does_not_count(encoder):
    for metric in (SRC, PATCH, AWAY):
        figures = metric.measure(replace(there_and_back(), predicted_at_once=4))
        assert figures.isfinite().tolist() == [False] * 6 + [True]


def test_the_guard_of_a_frozen_video_is_100_and_that_of_the_truth_less(encoder):
    clip = there_and_back()
    frozen = replace(clip, rgb=clip.rgb[:1].expand_as(clip.rgb))
    assert AWAY.measure(frozen)[4:].tolist() == SRC.measure(frozen)[4:].tolist() == pytest.approx([100.0] * 3)
    assert (AWAY.measure(clip)[4:] < SRC.measure(clip)[4:]).all()


def test_a_frame_counts_the_same_alone_and_among_others_to_the_bit(encoder):
    clip = there_and_back()
    alone = replace(clip, first_visits=torch.tensor([-1, -1, -1, -1, 2, -1, -1]))
    changed = replace(alone, rgb=clip.rgb.flip(0).clone())
    assert SRC.measure(replace(changed, first_visits=clip.first_visits))[4] == SRC.measure(changed)[4]


@needs_encoder
def test_real_features_distinguish_the_way_there_from_the_place():
    clip = there_and_back()
    assert (AWAY.measure(clip)[4:] < 97).all()
    assert (SRC.measure(clip)[4:] > 99.99).all()


def test_the_definition_names_the_weights_that_are_used(tmp_path, monkeypatch):
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path))
    assert SRC.obstacle(setup()) == (
        "weights dinov2-small or dinov2-s-derived are not here: persist weights fetch dinov2-small"
    )
    words = "no clip returns to a pose it had before over more than one predicted clip"
    assert SRC.obstacle(setup(returns=False)) == words
    write_json(tmp_path / "weights/dinov2-s-derived/weight.json", {})
    assert SRC.obstacle(setup()) is None
    assert "DINOv2-S-derived, block 8" in SRC.definition
    assert SRC.weights == ("dinov2-s-derived",)
    write_json(tmp_path / "weights/dinov2-small/weight.json", {})
    assert "DINOv2-S, block 12" in SRC.definition


def test_the_guard_compares_with_the_farthest_camera():
    assert farthest(there_and_back().truth.cameras, 0, 6) == 3


def test_a_metre_is_as_far_as_a_radian():
    poses = np.stack([look((x, 1.3, 0.2), yaw, 0.0) for x, yaw in ((0.0, 0.0), (1.0, 0.0), (0.0, 50.0))])
    assert farthest(observe_room(poses).cameras, 0, 2) == 1


def test_each_patch_is_compared_with_the_one_at_its_place_if_the_first_visit_sees_its_centre():
    earlier = torch.eye(6).double().reshape(2, 3, 6)  # patches of 20 pixels across and 10 down, each unlike the others
    places = pixel_centers(20, 60) + torch.tensor([20.0, 0.0])  # the view is one patch to the left
    seen = (places[..., 0] < 60) & (places[..., 0] % 20 > 5)
    patches = earlier.roll(-1, dims=1)
    assert patch_similarity(patches, earlier, Match(places, seen)) == pytest.approx(100)
    assert patch_similarity(patches, earlier, Match(places, torch.ones_like(seen))) == pytest.approx(200 / 3)


def test_the_guard_compares_the_first_visit_and_not_the_return_with_what_lies_between():
    assert AWAY.pairs(there_and_back()) == {4: (2, 3), 5: (1, 3), 6: (0, 3)}
