"""Consistency distillation: levels, the teacher's step, the boundary, and what a perfect teacher leaves to learn."""

import copy
import dataclasses

import pytest
import torch

from persist_backbones.cogvideox.diffusion import make_scheduler, noise_level, sample_generators
from persist_backbones.extensions.distillation import (
    Distillation,
    Levels,
    consistency_loss,
    consistency_target,
    ddim_step,
    distance,
    predict_clean,
)
from persist_backbones.noise_levels import draw_levels
from persist_cli.api.stages import Distill
from persist_cli.errors import CheckpointError, RecipeError
from tests.support.micro_model import FRAMEWISE, micro, random_clips, random_tokens, shaken, trained, with_adapter

PREDICTIONS = ["v_prediction", "sample"]


def shaken_micro(prediction="sample"):
    backbone = micro(prediction=prediction, **FRAMEWISE)
    shaken(backbone)
    return backbone


def distilled(student, teacher=None, **settings):
    return Distillation(Distill(**settings), copy.deepcopy(teacher or student), copy.deepcopy(student))


def test_timesteps_of_one_to_four_sampling_steps_are_levels_of_the_distillation():
    config, levels = micro().scheduler.config, set(Levels(48, 1000).timesteps.tolist())
    for steps in (1, 2, 3, 4):
        assert set(make_scheduler(config, "ddim", steps).timesteps.tolist()) <= levels


def test_each_level_is_followed_by_the_next_and_the_last_by_the_clean_clip():
    levels = Levels(4, 1000)
    following, last = levels.following(levels.timesteps)
    assert following[:3].tolist() == levels.timesteps[1:].tolist()
    assert last.tolist() == [False, False, False, True]


def test_each_level_is_drawn_and_no_other():
    levels = Levels(4, 1000)
    assert set(levels.draw(sample_generators(range(64))).tolist()) == set(levels.timesteps.tolist())


def test_the_teachers_step_to_the_true_clip_leaves_its_noise_as_it_is():
    scheduler, draw = micro().scheduler, torch.Generator().manual_seed(0)
    clean, noise = torch.randn(2, 3, 4, 2, 2, generator=draw), torch.randn(2, 3, 4, 2, 2, generator=draw)
    high, low = torch.tensor([999, 600]), torch.tensor([700, 20])
    noisy, expected = (scheduler.add_noise(clean, noise, timesteps) for timesteps in (high, low))
    stepped = ddim_step(clean, noisy, noise_level(scheduler, high), noise_level(scheduler, low))
    assert torch.allclose(stepped, expected, atol=1e-4)


@pytest.mark.parametrize("prediction", PREDICTIONS)
def test_without_noise_the_target_is_the_teachers_clip_itself(prediction):
    student, teacher = shaken_micro(prediction), shaken_micro(prediction)
    shaken(teacher)
    clips, distillation = random_clips(2), distilled(student, teacher)
    last = distillation.levels.timesteps[-1]
    noised = student.add_noise(clips, sample_generators(clips.seeds), lambda _: last.repeat(2))
    states = [generator.get_state() for generator in sample_generators(clips.seeds)]
    with torch.no_grad():
        target = consistency_target(clips, noised, states, distillation)
        assert torch.equal(target, predict_clean(distillation.teacher, clips, noised, states))
        assert not torch.allclose(target, predict_clean(distillation.target, clips, noised, states))


def test_a_consistent_teacher_is_a_fixed_point():
    student = micro(prediction="sample", **FRAMEWISE)  # its output layers are zero but for a bias: it predicts one clip
    shaken(student.codec)
    for layer in (student.transformer.base.proj_out, student.transformer.extra_out):
        torch.nn.init.zeros_(layer.weight)
    student.trained_parameters("1")
    losses = consistency_loss(student, random_clips(3), distilled(student, levels=6))
    losses["loss"].backward()
    assert losses["loss"] == losses["rgb"] == losses["depth"] == 0
    gradients = [p.grad.abs().max() for p in student.transformer.parameters() if p.grad is not None]
    assert max(gradients) == 0


@pytest.mark.parametrize("prediction", PREDICTIONS)
def test_an_inconsistent_teacher_is_learned_from(prediction):
    student = shaken_micro(prediction)
    student.trained_parameters("1")
    distillation = distilled(student)
    losses = consistency_loss(student, random_clips(2), distillation)
    losses["loss"].backward()
    assert losses["loss"] > 0
    assert student.transformer.base.proj_out.weight.grad.abs().max() > 0
    assert all(p.grad is None for model in (distillation.teacher, distillation.target) for p in model.parameters())


def test_the_target_is_another_where_the_teacher_has_guidance_over_memory():
    backbone = trained("canvas", prediction="sample", **FRAMEWISE)
    clips = random_clips(2, random_tokens(2, 9))
    states = [generator.get_state() for generator in sample_generators(clips.seeds)]
    noised = backbone.add_noise(clips, sample_generators(clips.seeds), lambda _: torch.tensor([999, 999]))
    plain, guided = (distilled(backbone, guidance=guidance) for guidance in (1.0, 3.0))
    with torch.no_grad():
        targets = [consistency_target(clips, noised, states, one) for one in (plain, guided)]
    assert not torch.allclose(*targets)


def test_the_target_is_another_at_the_noisier_levels_where_the_teacher_is_sampled_away_from_its_guide(tmp_path):
    backbone = shaken_micro()
    guide = micro(prediction="sample", **FRAMEWISE)
    shaken(guide, 0.02)
    guide.save_base(tmp_path)
    backbone.guide_folder = tmp_path
    clips = random_clips(2)
    states = [generator.get_state() for generator in sample_generators(clips.seeds)]
    noised = backbone.add_noise(clips, sample_generators(clips.seeds), lambda _: torch.tensor([999, 499]))
    plain, guided = (distilled(backbone, autoguidance=weight) for weight in (1.0, 3.0))
    with torch.no_grad():
        targets = [consistency_target(clips, noised, states, one) for one in (plain, guided)]
        own, weaker = (predict_clean(model, clips, noised, states) for model in (backbone, guide))
        taught = predict_clean(guided.teacher, clips, noised, states, 1.0, guided.autoguidance)
    torch.testing.assert_close(taught[0], weaker[0] + 3 * (own[0] - weaker[0]))
    assert torch.equal(taught[1], own[1])
    assert not torch.allclose(targets[0][0], targets[1][0])
    assert torch.equal(targets[0][1], targets[1][1])


def with_dropout():
    """A model whose adapter hides and disturbs memory in training, and clips of which some lose theirs."""
    backbone = with_adapter(
        micro(prediction="sample", **FRAMEWISE), form="canvas", head_width=8, dropout=0.5, noise=0.5
    )
    shaken(backbone)
    return backbone, random_clips(6, random_tokens(6, 9))


def test_student_and_teacher_see_the_same_memory():
    """At the last level the target is the teacher's clip, which a student of its weights predicts too."""
    backbone, clips = with_dropout()
    levels = Levels(2, 1000)
    last = [seed for seed in range(40) if levels.draw(sample_generators([seed])) == levels.timesteps[-1]]
    clips = dataclasses.replace(clips, seeds=last[:6])
    plain, guided = (distilled(backbone, levels=2, guidance=guidance) for guidance in (1.0, 3.0))
    assert consistency_loss(backbone, clips, plain)["loss"] == 0
    assert consistency_loss(backbone, clips, guided)["loss"] > 0


def test_teacher_and_target_see_the_same_memory():
    backbone, clips = with_dropout()
    distillation, high = distilled(backbone, levels=2), torch.full((6,), 999)
    noised = backbone.add_noise(clips, sample_generators(clips.seeds), lambda _: high)
    states = [generator.get_state() for generator in sample_generators(clips.seeds)]
    levels = (noise_level(backbone.scheduler, timesteps) for timesteps in (high, torch.full((6,), 499)))
    with torch.no_grad():
        stepped = ddim_step(predict_clean(backbone, clips, noised, states), noised.noisy, *levels)
        nearer = noised._replace(noisy=stepped, timesteps=torch.full((6,), 499))
        target = consistency_target(clips, noised, states, distillation)
        assert torch.equal(target, predict_clean(backbone, clips, nearer, states))
        assert not torch.allclose(target, predict_clean(backbone, clips, nearer, states[::-1]))


@pytest.mark.parametrize("guidance", [1.0, 3.0])
def test_the_teacher_steps_with_its_guidance_and_the_target_predicts_what_follows_without(guidance):
    teacher, clips = trained("canvas", prediction="sample", **FRAMEWISE), random_clips(2, random_tokens(2, 9))
    target = copy.deepcopy(teacher)
    shaken(target, 0.2)
    noised = teacher.add_noise(clips, sample_generators(clips.seeds), lambda _: torch.full((2,), 999))
    states = [generator.get_state() for generator in sample_generators(clips.seeds)]
    following = torch.full((2,), 499)
    levels = (noise_level(teacher.scheduler, timesteps) for timesteps in (noised.timesteps, following))
    with torch.no_grad():
        stepped = ddim_step(predict_clean(teacher, clips, noised, states, guidance), noised.noisy, *levels)
        nearer, settings = noised._replace(noisy=stepped, timesteps=following), Distill(levels=2, guidance=guidance)
        learned = consistency_target(clips, noised, states, Distillation(settings, teacher, target))
        assert torch.equal(learned, predict_clean(target, clips, nearer, states))


def test_student_teacher_and_target_are_told_the_noise_of_the_given_frame():
    backbone, clips, told = micro(image_noise=0.5, **FRAMEWISE), random_clips(2), []
    shaken(backbone)
    distillation = distilled(backbone)
    for model in (distillation.teacher, distillation.target, backbone):
        model.transformer.image_level.register_forward_pre_hook(lambda _, inputs: told.append(inputs[0]))
    consistency_loss(backbone, clips, distillation)
    levels = draw_levels(sample_generators(clips.seeds), 0.5)
    assert [torch.equal(level, levels) for level in told] == [True] * 3


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"levels": 2000}, "distill.levels=2000: this model was trained with 1000 noise levels"),
        ({"levels": 4, "steps": 5}, "distill.steps=5: a sampler has at most a step for each of 4 levels"),
        ({"steps": 5}, "distill.steps=5: its noise levels are not among 48; set distill.levels=50"),
    ],
)
def test_levels_that_the_model_or_the_sampler_does_not_have_are_refused(settings, message):
    student = micro(**FRAMEWISE)
    with pytest.raises(RecipeError, match=f"^{message}$"):
        student.distill(Distill(**settings), copy.deepcopy(student), copy.deepcopy(student))


def test_the_distances_are_zero_for_equal_latents_and_nearly_absolute_for_others():
    one, other = torch.zeros(1, 1, 1, 1, 2), torch.tensor([0.0, 3.0]).reshape(1, 1, 1, 1, 2)
    assert distance(one, other, "huber").flatten().tolist() == pytest.approx([0.0, 2.999])
    assert distance(one, other, "squared").flatten().tolist() == [0.0, 9.0]


@pytest.mark.parametrize("loss", ["huber", "squared"])
def test_the_loss_is_the_distance_that_the_settings_name(loss):
    student, clips = shaken_micro(), random_clips(2)
    distillation, generators = distilled(student, loss=loss), sample_generators(clips.seeds)
    noised = student.add_noise(clips, generators, distillation.levels.draw)
    states = [generator.get_state() for generator in generators]
    with torch.no_grad():
        target = consistency_target(clips, noised, states, distillation)
        expected = distance(predict_clean(student, clips, noised, states), target, loss).mean()
        assert torch.equal(consistency_loss(student, clips, distillation)["loss"], expected)


def test_a_distilled_model_asks_for_few_steps_without_guidance():
    student = shaken_micro()
    student.distill(Distill(steps=2, guidance=1.5), copy.deepcopy(student), copy.deepcopy(student))
    assert (student.own_sampling.steps, student.own_sampling.memory_guidance) == (2, 1.0)
    assert student(random_clips(2), "1")["loss"] > 0


def test_what_a_distilled_model_writes_itself_in_training_does_not_look_at_the_true_frames_that_follow():
    student, clips = shaken_micro(), random_clips(2)
    later = clips.rgb.clone()
    later[:, 1:] = 255 - later[:, 1:]
    others = dataclasses.replace(clips, rgb=later)
    assert not torch.equal(student.predict_once(clips)[0], student.predict_once(others)[0])
    student.distill(Distill(), copy.deepcopy(student), copy.deepcopy(student))
    assert torch.equal(student.predict_once(clips)[0], student.predict_once(others)[0])


@pytest.mark.parametrize(
    ("changes", "what"),
    [({"frames": 5, **FRAMEWISE}, "number of frames"), ({"frames": 17}, "codec and number of frames")],
)
def test_a_teacher_of_other_latents_is_refused(changes, what):
    student, teacher = micro(**FRAMEWISE), micro(**changes)
    with pytest.raises(CheckpointError, match=f"^distill.teacher: its {what} differ"):
        student.distill(Distill(), teacher, copy.deepcopy(student))


@pytest.mark.parametrize(
    ("own", "others", "what"),
    [
        ({"given": "rendered"}, {}, "views of the given frame"),
        ({}, {"given": "rendered"}, "views of the given frame"),
        ({"image_noise": 0.3}, {}, "noise of the given frame"),
        ({}, {"depth": False}, "depth"),
    ],
)
def test_a_teacher_that_does_not_know_what_it_is_given_is_refused(own, others, what):
    student, teacher = micro(**FRAMEWISE, **own), micro(**FRAMEWISE, **others)
    with pytest.raises(CheckpointError, match=f"^distill.teacher: its {what} differ"):
        student.distill(Distill(), teacher, copy.deepcopy(student))


def test_a_teacher_may_know_more_noise_and_depth_than_the_student_which_learns_no_depth():
    student, teacher = micro(**FRAMEWISE, depth=False), micro(**FRAMEWISE, image_noise=0.3)
    student.distill(Distill(), teacher, copy.deepcopy(student))
    losses = student(random_clips(2), "1")
    assert set(losses) == {"loss", "rgb"}
    assert losses["loss"] == losses["rgb"]


def test_a_teacher_of_other_noise_levels_is_refused():
    student = micro(**FRAMEWISE)
    teacher = copy.deepcopy(student)
    teacher.scheduler.alphas_cumprod = teacher.scheduler.alphas_cumprod.flip(0)
    with pytest.raises(CheckpointError, match=r"^distill\.teacher: its noise levels differ"):
        student.distill(Distill(), teacher, copy.deepcopy(student))


def test_a_teacher_with_another_adapter_is_refused():
    student, teacher = trained("canvas", **FRAMEWISE), trained("cross", **FRAMEWISE)
    teacher.codec.load_state_dict(student.codec.state_dict())
    with pytest.raises(CheckpointError, match="its memory adapter differ from those of the model"):
        student.distill(Distill(), teacher, copy.deepcopy(student))


def test_the_loss_is_that_of_short_clips_too():
    student = shaken_micro()
    short = random_clips(2).shortened(3)
    assert consistency_loss(student, short, distilled(student))["loss"] > 0
