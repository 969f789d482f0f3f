"""Consistency distillation: a student learns to predict in one step what its teacher comes to in many.

The student f predicts from noisy latents of any level the clean clip that they lead to (Song et al., 2303.01469). It is
the model's own clean prediction, and at the level without noise the identity: f(x, 0) = x, the boundary that keeps it
from predicting the same for everything. The loss is the distance between f(x_t, t) and the target's f(x_s, s), where
x_s is the teacher's DDIM step from x_t to the next level s (algorithm 2). ``consistency_loss`` puts this together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from persist_backbones.adapters.base import NoiseLevel
from persist_backbones.cogvideox.cogvideox import CogVideoX
from persist_backbones.cogvideox.diffusion import (
    NoisedClips,
    draw_among,
    loss_parts,
    make_scheduler,
    noise_level,
    sample_generators,
)
from persist_backbones.diffusers_models import CogVideoXDDIMScheduler
from persist_backbones.extensions.autoguidance import Autoguidance, autoguidance_of
from persist_cli.api.backbone import Clips
from persist_cli.api.stages import Distill
from persist_cli.errors import CheckpointError, RecipeError

HUBER = 1e-3  # below such an error the loss is squared, as in latent consistency models (2310.04378)


@dataclass(frozen=True)
class Levels:
    """Noise levels between which the teacher steps: timesteps evenly spaced, the last of training first.

    Args:
        count: number of levels; after the last of them nothing is left of the noise.
        trained: number of timesteps of training.
    """

    count: int
    trained: int

    @property
    def timesteps(self) -> Int[Tensor, " level"]:
        """The timestep of each level, falling; those of samplers with 1, 2, 3 or 4 steps are among 48."""
        return torch.tensor([round(self.trained * (1 - number / self.count)) - 1 for number in range(self.count)])

    def draw(self, generators: list[torch.Generator]) -> Int[Tensor, " batch"]:
        """Draw the timesteps of uniform levels, each sample from its own generator."""
        return draw_among(self.timesteps, generators)

    def strongest(self, generators: list[torch.Generator]) -> Int[Tensor, " batch"]:
        """Return the first level for each sample: noise alone, from which one step is sampled."""
        return self.timesteps[:1].expand(len(generators))

    def following(self, timesteps: Int[Tensor, " batch"]) -> tuple[Int[Tensor, " batch"], Bool[Tensor, " batch"]]:
        """Return the next timestep of each sample, and whether there is none: its step leads to the clean clip."""
        known = self.timesteps.to(timesteps.device)
        numbers = (known[None] == timesteps[:, None]).long().argmax(dim=1) + 1
        return known[numbers.clamp(max=self.count - 1)], numbers == self.count


def ddim_step(clean: Tensor, noisy: Tensor, level: NoiseLevel, following: NoiseLevel) -> Tensor:
    """Return the latents of the following noise level with the same clean latents and noise (DDIM, eq. 12, σ = 0).

    Args:
        clean: the clean latents as predicted.
        noisy: latents of ``level``.
        level: their noise level.
        following: a lower noise level.
    """
    noise = (noisy - level.signal * clean) / level.noise
    return following.signal * clean + following.noise * noise


def distance(
    predicted: Float[Tensor, "batch frame channel height width"],
    target: Float[Tensor, "batch frame channel height width"],
    loss: Literal["huber", "squared"],
) -> Float[Tensor, "batch frame channel height width"]:
    """Return how far two latents are from each other, for each value."""
    squared = (predicted - target).square()
    return squared if loss == "squared" else (squared + HUBER**2).sqrt() - HUBER


@dataclass(frozen=True)
class Distillation:
    """What a model is distilled with.

    Args:
        settings: levels, guidance and loss.
        teacher: the frozen model whose denoising is learned.
        target: the model that is trained, with averaged weights.
    """

    settings: Distill
    teacher: CogVideoX
    target: CogVideoX

    @property
    def levels(self) -> Levels:
        """The noise levels."""
        return Levels(self.settings.levels, self.teacher.scheduler.config.num_train_timesteps)

    @cached_property
    def autoguidance(self) -> Autoguidance | None:
        """The teacher's guidance away from its guide, which is loaded when it is first asked for."""
        return autoguidance_of(self.teacher, self.settings.autoguidance, {})


def consistency_loss(model: CogVideoX, clips: Clips, distillation: Distillation) -> dict[str, Tensor]:
    """Return the loss of consistency distillation of a batch, and its parts of RGB and depth."""
    generators, clips, levels = sample_generators(clips.seeds), clips.to(model.device), distillation.levels
    noised = model.add_noise(clips, generators, levels.draw)
    states = [generator.get_state() for generator in generators]  # all three models see the same memory
    with torch.no_grad():
        target = consistency_target(clips, noised, states, distillation)
    error = distance(predict_clean(model, clips, noised, states), target, distillation.settings.loss)
    return loss_parts(error, model.settings.depth)


def consistency_target(
    clips: Clips, noised: NoisedClips, generator_states: Sequence[Tensor], distillation: Distillation
) -> Tensor:
    """Return the clean latents that the target predicts after the teacher's step; arguments as of ``predict_clean``."""
    teacher, guidance = distillation.teacher, distillation.settings.guidance
    guided = predict_clean(teacher, clips, noised, generator_states, guidance, distillation.autoguidance)
    following, last = distillation.levels.following(noised.timesteps)
    here, there = (noise_level(teacher.scheduler, timesteps) for timesteps in (noised.timesteps, following))
    nearer = noised._replace(noisy=ddim_step(guided, noised.noisy, here, there), timesteps=following)
    predicted = predict_clean(distillation.target, clips, nearer, generator_states)
    return torch.where(last[:, None, None, None, None], guided, predicted)  # the boundary: f(x, 0) = x


def predict_clean(
    model: CogVideoX,
    clips: Clips,
    noised: NoisedClips,
    generator_states: Sequence[Tensor],
    guidance: float = 1.0,
    autoguidance: Autoguidance | None = None,
) -> Float[Tensor, "batch frame channel height width"]:
    """Return the clean latents as a model predicts them from noisy ones, float32.

    Args:
        model: the model.
        clips: the clips, with memory tokens.
        noised: their latents with noise.
        generator_states: for each sample the state of the generator that draws whether it sees no memory.
        guidance: weight of guidance over memory.
        autoguidance: guidance of this model away from a weaker version.
    """
    memory = model.memory_condition(clips, [torch.Generator().set_state(state) for state in generator_states])
    conditions = model.conditions(clips, noised.timesteps, memory, noised.image_noise)
    with model.transformer.kernel_for_training(noised.noisy):
        predicted = model.predict_guided(noised.noisy, noised.image, conditions, guidance)
        if autoguidance is not None:
            predicted = autoguidance.lead(predicted, noised.noisy, noised.image, conditions)
    return conditions.level.clean(predicted.float(), noised.noisy.float())


def check_teacher(student: CogVideoX, teacher: CogVideoX) -> None:
    """Raise ``CheckpointError`` unless a teacher's latents, noise levels and memory mean the same to a student.

    Both get the student's image condition, so the teacher must know such conditions, and noise on them.
    """
    adapters = [None if model.adapter is None else model.adapter.settings for model in (student, teacher)]
    own, others = student.settings, teacher.settings
    differences = {
        "codec": student.encoding() != teacher.encoding(),
        "number of frames": own.frames != others.frames,
        "views of the given frame": own.given != others.given,
        "noise of the given frame": own.image_noise > others.image_noise,
        "depth": own.depth and not others.depth,
        "noise levels": not torch.equal(student.scheduler.alphas_cumprod, teacher.scheduler.alphas_cumprod),
        "memory adapter": adapters[0] != adapters[1],
    }
    differs = [name for name, other in differences.items() if other]
    if differs:
        raise CheckpointError(f"distill.teacher: its {' and '.join(differs)} differ from those of the model to train")


def check_guided(settings: Distill, teacher: CogVideoX) -> None:
    """Raise ``CheckpointError`` when a teacher shall be sampled away from a guide that it has not."""
    if settings.autoguidance != 1 and teacher.guide_folder is None:
        raise CheckpointError(
            f"distill.autoguidance={settings.autoguidance:g}: the teacher has no guide; persist export --guide puts a "
            "weaker version of the model beside it"
        )


def check_levels(settings: Distill, scheduler: CogVideoXDDIMScheduler) -> None:
    """Raise ``RecipeError`` for more levels than the model was trained with, or for sampling steps at other levels."""
    trained, steps = scheduler.config.num_train_timesteps, settings.steps
    if settings.levels > trained:
        raise RecipeError(f"distill.levels={settings.levels}: this model was trained with {trained} noise levels")
    if steps > settings.levels:
        raise RecipeError(f"distill.steps={steps}: a sampler has at most a step for each of {settings.levels} levels")
    sampled = set(make_scheduler(scheduler.config, "ddim", steps).timesteps.tolist())
    counts = range(settings.levels, trained + 1)
    fitting = next(count for count in counts if sampled <= set(Levels(count, trained).timesteps.tolist()))
    if fitting != settings.levels:
        raise RecipeError(
            f"distill.steps={steps}: its noise levels are not among {settings.levels}; set distill.levels={fitting}"
        )
