"""What the model of scenes is trained on and told, part by part, and that each setting of these has its effect."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from persist_cli.api.cameras import Cameras
from persist_cli.api.cells import is_solid
from persist_cli.api.geometry import camera_rays
from persist_cli.api.scene_model import Given
from persist_memory.scene_models.conditions import known_tokens
from persist_memory.scene_models.scene_diffusion import Told, generators_of
from persist_memory.scene_models.transformer import rotary_positions, rotate
from tests.support.micro_scenes import MICRO_SCENE, micro_model, micro_samples


def model_with(part="transformer", **settings):
    """A micro model with some settings of a part of it."""
    return micro_model(**{part: MICRO_SCENE.get(part, {}) | settings})


def moving(model):
    """The model with a transformer whose velocities are not zero, as those of a new one are."""
    with torch.no_grad():
        for parameter in model.transformer.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1)))
    return model


@pytest.fixture(scope="module")
def samples():
    return micro_samples(3)


@pytest.fixture(scope="module")
def half_known(samples):
    """Samples of which the first half of the window is given for good."""
    given = torch.zeros_like(samples.given)
    given[:, :8] = int(Given.CONTENT)
    known = {"classes": samples.true_classes * (given > 0), "colors": samples.true_colors * (given > 0)[..., None]}
    return replace(samples, given=given, **known)


def test_the_loss_of_the_codec_is_the_sum_of_its_parts_by_their_weights(samples):
    losses = model_with("codec", color_weight=3.0, kl_weight=50.0)(samples, "scene-codec")
    parts = losses["cross_entropy"] + 3.0 * losses["color_error"] + 50.0 * losses["divergence"]
    assert losses["loss"].item() == pytest.approx(parts.item(), rel=1e-5)
    assert losses["color_error"] > 0.01
    assert losses["divergence"] > 1e-3


def test_the_error_of_colours_is_that_of_what_is_solid(samples, monkeypatch):
    model, read = micro_model(), []
    read_off = model.codec.read_off
    monkeypatch.setattr(model.codec, "read_off", lambda latents: read.append(read_off(latents)) or read[-1])
    error = model(samples, "scene-codec")["color_error"]
    solid = is_solid(samples.true_classes)
    expected = (read[0][1] - samples.true_colors / 255)[solid].abs().mean()
    assert error.item() == pytest.approx(expected.item(), rel=1e-4)


@pytest.mark.parametrize(("noise", "spread"), [(0.0, 2.0), (0.5, 0.5 * 8**0.5)])
def test_the_codec_learns_from_latents_of_the_deviation_it_says_and_with_the_noise_of_the_settings(
    samples, monkeypatch, noise, spread
):
    model, read = model_with("codec", noise=noise), []
    posterior, read_off = model.codec.posterior, model.codec.read_off

    def of_deviation_two(*cells):
        mean, _ = posterior(*cells)
        return torch.zeros_like(mean), torch.full_like(mean, 4.0).log()

    monkeypatch.setattr(model.codec, "posterior", of_deviation_two)
    monkeypatch.setattr(model.codec, "read_off", lambda latents: read.append(latents) or read_off(latents))
    model(samples, "scene-codec")
    assert read[0].std().item() == pytest.approx(spread, rel=0.1)


def test_the_transformer_learns_the_way_from_latents_to_noise(samples, monkeypatch):
    model, mixed = micro_model(), []
    mix = model._mix
    monkeypatch.setattr(
        model, "_mix", lambda clean, noise, *rest: mixed.append((clean, noise)) or mix(clean, noise, *rest)
    )
    monkeypatch.setattr(model.transformer, "forward", lambda *_: mixed[-1][1] - mixed[-1][0])
    assert model(samples, "scene")["loss"] == 0.0


def test_what_is_predicted_of_known_tokens_does_not_count(half_known, monkeypatch):
    model = micro_model()
    known = model._places(known_tokens(half_known, model.settings).float())
    losses = []
    for wrong in (0.0, 100.0):
        monkeypatch.setattr(model.transformer, "forward", lambda latents, *_, by=wrong: (by * known).expand_as(latents))
        losses.append(model(half_known, "scene")["loss"].item())
    assert losses[0] == losses[1] > 0


def test_latents_have_the_noise_of_their_level_and_known_ones_that_of_conditions(half_known):
    model = model_with(condition_noise=0.3)
    known = known_tokens(half_known, model.settings)
    assert known.any()
    clean = model._held(half_known)
    levels = torch.full(known.shape, 0.8)
    tokens = model._tokens(model._mix(torch.zeros_like(clean), torch.ones_like(clean), levels, known))
    assert torch.allclose(tokens[known], torch.tensor(0.3))
    assert torch.allclose(tokens[~known], torch.tensor(0.8))
    tokens = model._tokens(model._mix(torch.ones_like(clean), torch.zeros_like(clean), levels, known))
    assert torch.allclose(tokens[known], torch.tensor(0.7))


@pytest.mark.parametrize(("share", "hears"), [(0.0, False), (0.5, True)])
def test_the_colours_of_the_view_have_the_noise_of_conditions(samples, share, hears):
    model = model_with(condition_noise=share)
    shown = torch.zeros(3, dtype=torch.bool)
    one, other = (
        model.tell(seeded, model._held(seeded), generators_of(seeded), shown).view
        for seeded in (samples, replace(samples, seeds=samples.seeds + 9))
    )
    assert torch.equal(one, other) is not hears


@pytest.mark.parametrize(("share", "sees"), [(0.0, True), (0.999, False)])
def test_training_hides_the_view_from_the_share_of_the_settings(samples, share, sees):
    model = moving(model_with(drop_view=share))
    one, other = (model(seen, "scene")["loss"] for seen in (samples, replace(samples, rgb=255 - samples.rgb)))
    assert torch.equal(one, other) is not sees


def test_guidance_goes_so_many_times_as_far_from_what_is_predicted_without_a_view(samples):
    model = moving(model_with("sampling", guidance=3.0))
    seen, unseen = model._tell_guided(samples, model._held(samples), generators_of(samples))
    assert not torch.equal(seen.view, unseen.view)
    latents, levels = model._held(samples), torch.full(known_tokens(samples, model.settings).shape, 0.6)

    def predicted(told: Told):
        return model.transformer(latents, levels, told.given, told.view, told.action)

    with torch.no_grad():
        expected = predicted(unseen) + 3.0 * (predicted(seen) - predicted(unseen))
        assert torch.allclose(model._velocity(latents, levels, (seen, unseen)), expected, atol=1e-5)
        assert not torch.allclose(predicted(seen), predicted(unseen), atol=1e-4)


def test_known_tokens_are_shown_alike_in_all_steps_until_a_snap(half_known, monkeypatch):
    model, shown = moving(model_with("sampling", snap_every=0)), []
    forward = model.transformer.forward
    monkeypatch.setattr(
        model.transformer, "forward", lambda latents, *rest: shown.append(latents) or forward(latents, *rest)
    )
    model.sample(half_known, 3)
    known = known_tokens(half_known, model.settings)
    first, *later = (model._tokens(latents)[known] for latents in shown)
    assert len(later) == 2
    assert all(torch.allclose(first, other, atol=1e-6) for other in later)


@pytest.mark.parametrize(("every", "below", "snaps"), [(0, 1.0, 0), (1, 1.0, 3), (1, 0.5, 2), (2, 1.0, 1), (1, 0.0, 0)])
def test_samples_snap_after_so_many_steps_from_a_noise_level_on(samples, monkeypatch, every, below, snaps):
    model, taken = model_with("sampling", snap_every=every, snap_below=below, shift=1.0), []
    snapped = model._snapped
    monkeypatch.setattr(model, "_snapped", lambda *latents: taken.append(latents) or snapped(*latents))
    model.sample(samples, 4)
    assert len(taken) == snaps + 1  # the last is the sample itself


def test_each_token_has_a_position_of_its_own_and_attention_depends_on_their_distance(samples):
    model = micro_model()
    cosines, sines = rotary_positions(model.settings, torch.device("cpu"))
    assert len(torch.cat([cosines, sines], dim=1).unique(dim=0)) == len(cosines) == 16
    query, key = torch.randn(2, 1, 1, 1, 2 * cosines.shape[1])
    turned_query, turned_key = (rotate(part.expand(-1, -1, 16, -1), (cosines, sines))[0, 0] for part in (query, key))
    products = (turned_query @ turned_key.T).unflatten(0, (4, 4)).unflatten(2, (4, 4))
    assert torch.allclose(products[:3, :3, :3, :3], products[1:, 1:, 1:, 1:], atol=1e-5)
    assert not torch.allclose(products[0, 0, 0], products[0, 0, 1], atol=1e-4)


def test_rays_are_those_of_the_lens_and_the_middle_of_the_window_is_the_origin(samples):
    model = micro_model()
    lens = torch.tensor([[20.0, 0, 7.0], [0, 12.0, 9.5], [0, 0, 1]]).expand(3, 3, 3)
    poses = samples.window_from_camera.clone()
    poses[:, :3, 3] = (torch.tensor(model.settings.shape) - 1) * model.settings.cell / 2
    poses[1, 0, 3] += model.view.unit
    origins, directions = model.view.rays(replace(samples, intrinsics=lens, window_from_camera=poses))
    expected = camera_rays(Cameras(poses.double(), lens.double(), 16, 16)) @ poses[:, None, :3, :3].double().mT
    assert torch.allclose(directions, expected.permute(0, 3, 1, 2).float(), atol=1e-5)
    assert torch.allclose(origins[..., 0, 0], torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 0, 0]]), atol=1e-6)


@pytest.mark.parametrize("told", ["action", "carried", "carried_color", "window_from_camera"])
def test_the_transformer_is_told_the_action_what_is_carried_and_where_the_camera_is(samples, told):
    model = micro_model()
    other = {
        "action": torch.ones_like(samples.action),
        "carried": torch.full_like(samples.carried, 4),
        "carried_color": torch.full_like(samples.carried_color, 200),
        "window_from_camera": samples.window_from_camera.roll(1, 0),
    }[told]
    origins = model.view.rays(samples)[0][:, :, 0, 0]
    assert not torch.allclose(model.action(samples, origins), model.action(replace(samples, **{told: other}), origins))


def test_the_transformer_reads_what_is_given_of_the_cells(half_known):
    model = moving(micro_model())
    latents, levels = model._held(half_known), torch.full(known_tokens(half_known, model.settings).shape, 0.6)
    told = model.tell(half_known, latents, generators_of(half_known), torch.zeros(3, dtype=torch.bool))
    with torch.no_grad():
        read, not_read = (
            model.transformer(latents, levels, given, told.view, told.action) for given in (told.given, 0 * told.given)
        )
    assert not torch.allclose(read, not_read, atol=1e-4)
