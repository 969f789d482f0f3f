"""Adversarial training: what the discriminator compares, which loss trains whom, and that it learns."""

from __future__ import annotations

import dataclasses
import math
from functools import partial

import pytest
import torch

from persist_backbones.cogvideox.diffusion import draw_among, make_scheduler, sample_generators
from persist_backbones.extensions.adversarial import (
    Discriminator,
    adversarial_loss,
    as_long_as,
    directed,
    discriminator_loss,
    sampled_timesteps,
    steepness,
    to_compare,
)
from persist_cli.api.stages import Adversarial
from persist_cli.errors import RecipeError
from tests.support.micro_model import FRAMEWISE, equal, micro, random_clips, random_tokens, shaken, trained
from tests.support.micro_runs import MICRO

SETTINGS = Adversarial(steps=4, width=8)
PLAIN = Adversarial(weight=1e-30, steps=4, width=8)  # no weight at all on passing


def trained_against(settings=SETTINGS, stage="1", **changes):
    torch.manual_seed(0)
    model = micro(**FRAMEWISE, **changes) if stage == "1" else trained("canvas", **FRAMEWISE, **changes)
    shaken(model)
    model.train_adversarially(settings)
    return model, model.trained_parameters(stage)


def sample_of(clips, number):
    """One sample of a batch, as a batch of one."""
    one = slice(number, number + 1)
    values = {name: getattr(clips, name)[one] for name in ("rgb", "depth", "cameras", "interactions", "seeds")}
    return dataclasses.replace(clips, **values)


def gradients(model, parameters, clips, settings, loss="loss"):
    """The gradients of one of the losses by parameter; zeros where it has none."""
    losses = adversarial_loss(model, clips, model.discriminator, settings)
    found = torch.autograd.grad(losses[loss], parameters.values(), allow_unused=True)
    pairs = zip(parameters.items(), found, strict=True)
    return {name: torch.zeros_like(p) if gradient is None else gradient for (name, p), gradient in pairs}


def test_it_trains_at_the_noise_levels_of_the_sampler_that_the_checkpoint_asks_for():
    model, _ = trained_against()
    timesteps = sampled_timesteps(model, SETTINGS)
    assert (model.own_sampling.steps, model.own_sampling.sampler) == (4, "ddim")
    assert timesteps.tolist() == make_scheduler(model.scheduler.config, "ddim", 4).timesteps.tolist()
    drawn = draw_among(timesteps, sample_generators(range(40)))
    assert set(drawn.tolist()) == set(timesteps.tolist())
    assert drawn[7] == draw_among(timesteps, sample_generators([7]))  # whatever the batch


@pytest.mark.parametrize("given", ["alone", "rendered"])
@pytest.mark.parametrize("weights", ["equal", "root-pixels"])
def test_frames_after_the_given_one_are_compared_beside_what_it_shows(given, weights):
    model, _ = trained_against(given=given, channel_weights=weights)
    clips = random_clips(2)
    draw = partial(draw_among, sampled_timesteps(model, SETTINGS))
    prediction = model.predict_noised(clips, sample_generators(clips.seeds), draw)
    true, predicted, image = to_compare(model, clips, prediction)
    scale, noised = model.channel_weights().sqrt(), prediction.noised
    assert torch.allclose(true, noised.clean[:, 1:] * scale)
    assert torch.allclose(predicted, prediction.clean(model.scheduler)[:, 1:] * scale)
    shown = noised.image[:, :1].expand_as(true) if given == "alone" else noised.image[:, 1:]
    assert torch.allclose(image, shown * scale)
    assert image.any()


def test_a_model_without_depth_is_compared_by_colours_alone():
    model, parameters = trained_against(depth=False)
    clips = random_clips(2)
    deeper = dataclasses.replace(clips, depth=clips.depth + 1)
    losses, others = (adversarial_loss(model, batch, model.discriminator, SETTINGS) for batch in (clips, deeper))
    assert losses["loss"] == others["loss"]
    assert losses["discriminator"] == others["discriminator"]
    depth = gradients(model, parameters, clips, SETTINGS)["transformer.extra_out.weight"]
    assert not depth.any()  # nothing trains what the model predicts of depth


def test_padding_is_not_compared():
    rotary = {"patch_size_t": 2, "patch_bias": False, "use_rotary_positional_embeddings": True}
    model = micro(transformer=MICRO["transformer"] | rotary, given="alone")
    model.train_adversarially(SETTINGS)
    clips = random_clips(1)
    draw = partial(draw_among, sampled_timesteps(model, SETTINGS))
    prediction = model.predict_noised(clips, sample_generators(clips.seeds), draw)
    true, predicted, image = to_compare(model, clips, prediction)
    assert true.shape[1] == prediction.noised.clean.shape[1] - 2  # a latent frame of padding, and the given one
    assert true.shape == predicted.shape == image.shape
    assert image.any()


@pytest.mark.parametrize("stage", ["1", "2"])
def test_either_loss_trains_its_own_network_alone(stage):
    model, parameters = trained_against(stage=stage)
    clips = random_clips(3, random_tokens(3, 9) if stage == "2" else None)
    both = gradients(model, parameters, clips, SETTINGS)
    unopposed = gradients(model, parameters, clips, PLAIN)
    own = gradients(model, parameters, clips, SETTINGS, "discriminator")
    for name in parameters:
        if name.startswith("discriminator."):
            assert torch.equal(both[name], unopposed[name]), name
        else:
            assert not own[name].any(), name
    changed = [name for name in parameters if not torch.equal(both[name], unopposed[name])]
    assert any(name.startswith("transformer." if stage == "1" else "adapters.") for name in changed)


def test_clips_that_are_alike_cannot_be_told_apart():
    judge, clips = Discriminator(3, (16, 16), 8), torch.randn(2, 3, 3, 16, 16)
    apart, steep, pull = discriminator_loss(judge, clips, clips, torch.zeros_like(clips))
    assert apart.item() == pytest.approx(math.log(2))
    assert steep > 0
    assert pull.shape == clips.shape


@pytest.mark.parametrize("frames", [1, 3])
def test_scores_are_as_steep_as_they_are_in_clips_of_any_length(frames):
    clips = torch.randn(2, frames, 3, 4, 4, requires_grad=True)
    scores = 2.0 * clips[:, None, :, 0, :1, :1]  # of one pixel alone
    assert steepness(scores, clips).item() == pytest.approx(4.0)
    assert steepness(scores.expand(-1, -1, -1, 4, 4), clips).item() == pytest.approx(4.0)  # the mean of the places


@pytest.mark.parametrize("size", [(4, 4), (7, 9), (16, 24), (60, 90)])
def test_latents_of_any_size_are_scored_in_a_map_of_a_few_places(size):
    scores = Discriminator(2, size, 4)(torch.zeros(1, 2, 2, *size), torch.zeros(1, 2, 2, *size))
    assert 4 <= min(scores.shape[3:]) < 8


def test_the_discriminator_learns_to_tell_and_the_model_learns_to_pass():
    torch.manual_seed(0)
    judge, image = Discriminator(2, (8, 8), 16), torch.zeros(16, 2, 2, 8, 8)
    optimizer = torch.optim.Adam(judge.parameters(), 1e-3)
    sharp, blurred = torch.randn(16, 2, 2, 8, 8), 0.1 * torch.randn(16, 2, 2, 8, 8)
    for _ in range(40):
        apart, steep, _ = discriminator_loss(judge, sharp, blurred, image)
        optimizer.zero_grad()
        (apart + 0.1 * steep).backward()
        optimizer.step()
    assert apart < 0.2
    others = torch.randn(16, 2, 2, 8, 8)
    assert judge(others, image).mean() > judge(0.1 * others, image).mean()
    passing = 0.1 * others
    _, _, pull = discriminator_loss(judge, others, passing, image)
    assert judge(passing - 100 * pull, image).mean() > judge(passing, image).mean()


def test_a_clip_is_pulled_to_pass_as_strongly_as_denoising_pulls_it():
    denoising, passing = (
        torch.tensor([[3.0, 4.0], [0.0, 1.0], [2.0, 0.0]]),
        torch.tensor([[0.0, 0.1], [7.0, 0.0], [0.0, 0.0]]),
    )
    assert as_long_as(denoising, passing).tolist() == [[0.0, 5.0], [1.0, 0.0], [0.0, 0.0]]
    predicted = torch.ones(3, 2, requires_grad=True)
    loss = directed(predicted, passing)
    loss.backward()
    assert loss.item() == 0.0
    assert torch.equal(predicted.grad, passing)


def test_the_pull_grows_with_the_weight_and_not_with_the_scores():
    model, parameters = trained_against()
    clips = random_clips(2)
    unopposed = gradients(model, parameters, clips, PLAIN)
    names = [name for name in parameters if name.startswith("transformer.") and unopposed[name].any()]

    def pull(weight):
        both = gradients(model, parameters, clips, Adversarial(weight=weight, steps=4, width=8))
        return torch.cat([(both[name] - unopposed[name]).flatten() for name in names])

    once = pull(0.3)
    assert once.any()
    assert torch.allclose(pull(0.6), 2 * once, rtol=1e-3, atol=1e-6)
    with torch.no_grad():
        model.discriminator.layers[-1].weight.mul_(2)
    assert pull(0.3).norm().item() == pytest.approx(once.norm().item(), rel=0.05)


def test_the_penalty_of_steep_scores_has_the_weight_of_the_settings():
    model, _ = trained_against()
    clips = random_clips(2)
    none, once, thrice = (
        adversarial_loss(model, clips, model.discriminator, Adversarial(penalty=penalty, steps=4, width=8))["loss"]
        for penalty in (1e-30, 0.5, 1.5)
    )
    assert once > none
    assert (thrice - none).item() == pytest.approx(3 * (once - none).item(), rel=1e-3)


@pytest.mark.parametrize("width", [8, 12])
def test_the_first_block_of_the_discriminator_is_as_wide_as_the_settings_say(width):
    model, _ = trained_against(Adversarial(steps=4, width=width))
    assert model.discriminator.layers[0].out_channels == width


def test_a_step_of_the_shared_optimizer_trains_both():
    model, parameters = trained_against()
    before = {name: parameter.detach().clone() for name, parameter in parameters.items()}
    optimizer = torch.optim.AdamW(parameters.values(), 1e-3)
    losses = model(random_clips(2), "1")
    losses["loss"].backward()
    optimizer.step()
    changed = {name.split(".")[0] for name, old in before.items() if not torch.equal(old, parameters[name])}
    assert changed == {"transformer", "discriminator"}
    assert set(losses) == {"loss", "rgb", "depth", "discriminator"}


def test_a_sample_has_the_same_loss_in_any_batch():
    model, _ = trained_against()
    clips = random_clips(3)
    together = model(clips, "1")
    alone = [model(sample_of(clips, number), "1") for number in range(3)]
    for name, loss in together.items():
        assert loss.item() == pytest.approx(sum(one[name].item() for one in alone) / 3, rel=1e-4), name


def test_the_discriminator_is_no_part_of_the_model_that_is_saved(tmp_path):
    model, _ = trained_against()
    assert "discriminator" in [group.name for group in model.parameter_groups()]
    assert not any(name.startswith("discriminator.") for name in model.trained_parameters("codec"))
    model.save_base(tmp_path / "with")
    again = micro(**FRAMEWISE)
    again.load_base(tmp_path / "with")
    saved = {name: value for name, value in model.state_dict().items() if not name.startswith("discriminator.")}
    assert equal([*saved.values()], [again.state_dict()[name] for name in saved])


def test_more_steps_than_noise_levels_are_refused():
    with pytest.raises(RecipeError, match=r"^adversarial.steps=2000: this model was trained with 1000 noise levels$"):
        micro(**FRAMEWISE).train_adversarially(Adversarial(steps=2000))
