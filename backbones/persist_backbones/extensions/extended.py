"""The plugin ``cogvideox``: the model with all optional extensions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from persist_backbones.cogvideox.cogvideox import CogVideoX
from persist_backbones.cogvideox.config import CogVideoXSettings
from persist_backbones.cogvideox.diffusion import DrawTimesteps, SamplingStep
from persist_backbones.cogvideox.model import Conditions, WorldTransformer
from persist_backbones.cogvideox.parameter_groups import DISCRIMINATOR
from persist_backbones.cogvideox.parts import DiffusersParts, save_world
from persist_backbones.cogvideox.prompt import computed_prompt
from persist_backbones.extensions.adversarial import Discriminator, adversarial_loss, make_discriminator
from persist_backbones.extensions.autoguidance import Autoguidance, Guide, autoguidance_of, load_guide
from persist_backbones.extensions.distillation import (
    Distillation,
    check_guided,
    check_levels,
    check_teacher,
    consistency_loss,
)
from persist_backbones.extensions.inference import bring_when_run, prepare_inference
from persist_backbones.extensions.lora import add_lora, save_lora, train_lora
from persist_backbones.extensions.savings import FrozenWeights, apply_memory_savings
from persist_cli.api.backbone import Backbone, Clips, Sampling
from persist_cli.api.inference import CONSISTENCY, InferenceOptions
from persist_cli.api.stages import Adversarial, Distill, Lora, MemorySavings, Stage
from persist_cli.errors import CheckpointError

if TYPE_CHECKING:
    from persist_backbones.extensions.caches import ClipCaches
    from persist_backbones.extensions.offload import OffloadedParts


class ExtendedCogVideoX(CogVideoX):
    """CogVideoX with LoRA, memory savings in training, and CPU offload, caches and autoguidance in sampling.

    Args:
        settings: the preset or pretrained directory, and sizes.
    """

    def __init__(self, settings: CogVideoXSettings) -> None:
        super().__init__(settings)
        self.frozen = FrozenWeights(self, None)
        self.offloaded: OffloadedParts | None = None
        self.caches: ClipCaches | None = None  # while a clip is sampled
        self.guides: dict[Path, Guide] = {}  # those that were needed, by folder; no part of the model
        self.autoguidance: Autoguidance | None = None  # while a clip is sampled
        self.distillation: Distillation | None = None
        self.adversarial: Adversarial | None = None
        self.discriminator: Discriminator | None = None

    def set_parts(self, parts: DiffusersParts) -> None:
        """Build the model from diffusers' parts, which may be offloaded."""
        super().set_parts(parts)
        bring_when_run(self.transformer)

    @classmethod
    def compute_once(cls, settings: CogVideoXSettings, folder: Path, begun: Path | None) -> dict[str, Any]:
        """Return the file of the prompt's embedding: T5 is large, and its results differ by machine."""
        return computed_prompt(settings, folder, begun)

    def forward(self, clips: Clips, stage: Stage) -> dict[str, Tensor]:
        """Return the training loss: of distillation or adversarial training, else that of ``CogVideoX``."""
        if self.distillation is not None:
            return consistency_loss(self, clips, self.distillation)
        if self.discriminator is not None and self.adversarial is not None:
            return adversarial_loss(self, clips, self.discriminator, self.adversarial)
        return super().forward(clips, stage)

    def predict_once(self, clips: Clips, draw: DrawTimesteps | None = None) -> tuple[Tensor, Tensor]:
        """Return the clips as predicted in one step; a model that is distilled begins with noise, as when sampled."""
        return super().predict_once(clips, draw if self.distillation is None else self.distillation.levels.strongest)

    def distill(self, settings: Distill, teacher: Backbone, target: Backbone) -> None:
        """Let ``forward`` return the loss of consistency distillation; see ``distillation``."""
        if not isinstance(teacher, CogVideoX) or not isinstance(target, CogVideoX):
            raise CheckpointError(f"distill.teacher: a model of backbone {teacher.name!r} cannot teach {self.name!r}")
        if teacher is not self:  # as where memory is estimated, and tensors have no values
            check_teacher(self, teacher)
            check_guided(settings, teacher)
            check_levels(settings, self.scheduler)
        self.distillation = Distillation(settings, teacher, target)
        self.own_sampling = Sampling(settings.steps, CONSISTENCY)

    def train_adversarially(self, settings: Adversarial) -> list[nn.Parameter]:
        """Let ``forward`` return the loss of adversarial training; see ``adversarial``."""
        self.adversarial, self.discriminator = settings, make_discriminator(self, settings)
        self.own_sampling = Sampling(settings.steps, "ddim")
        return [*self.discriminator.parameters()]

    def sample(
        self,
        first: Clips,
        sampling: Sampling,
        on_step: Callable[[SamplingStep], None] | None = None,
        generators: list[torch.Generator] | None = None,
        noise: Tensor | None = None,
    ) -> Tensor:
        """Denoise latents of clips from noise, with enabled caches and autoguidance; see ``CogVideoX.sample``."""
        if has_cache(self.transformer):
            from persist_backbones.extensions.caches import ClipCaches  # diffusers' hooks take a second to import

            self.caches = ClipCaches(self.transformer)
        try:
            self.autoguidance = autoguidance_of(self, sampling.autoguidance, self.guides)
            return super().sample(first, sampling, on_step, generators, noise)
        finally:
            if self.autoguidance is not None and self.offloaded is not None:
                self.autoguidance.guide.to("cpu")
            self.autoguidance = None
            if self.caches is not None:
                self.caches.forget()
                self.caches = None

    def check_guide(self, folder: Path) -> None:
        """Raise ``CheckpointError`` when the video model in a folder has other sizes than this one."""
        load_guide(self, folder)

    def predict_guided(self, noisy: Tensor, image: Tensor, conditions: Conditions, guidance: float) -> Tensor:
        """Predict with guidance over memory, and away from the guide."""
        predicted = super().predict_guided(noisy, image, conditions, guidance)
        return predicted if self.autoguidance is None else self.autoguidance.lead(predicted, noisy, image, conditions)

    def predict(self, noisy: Tensor, image: Tensor, conditions: Conditions, branch: str = "cond") -> Tensor:
        """Predict from noisy latents; a cache may replace some blocks of the transformer."""
        if self.caches is None:
            return super().predict(noisy, image, conditions, branch)
        with self.caches.prediction(branch, conditions):
            return super().predict(noisy, image, self.caches.around(conditions), branch)

    def generate(self, first: Clips, sampling: Sampling) -> tuple[Tensor, Tensor]:
        """Generate clips from each sample's own noise; offloaded weights are on the CPU again afterwards."""
        clips = super().generate(first, sampling)
        if self.offloaded is not None:
            self.offloaded.maybe_free_model_hooks()
        return clips

    def generate_frame(self, first: Clips, sampling: Sampling, frames: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Generate clips and return a frame of each; offloaded weights are on the CPU again afterwards."""
        chosen = super().generate_frame(first, sampling, frames)
        if self.offloaded is not None:
            self.offloaded.maybe_free_model_hooks()
        return chosen

    def prepare_inference(self, options: InferenceOptions) -> None:
        """Get ready to sample; offloaded weights are on the CPU between clips."""
        self.offloaded = prepare_inference(self, self.offloaded, options, options.device())

    def trained_parameters(self, stage: Stage) -> dict[str, nn.Parameter]:
        """Freeze all that the stage does not train and return the rest by name; with LoRA stage 1 freezes the base."""
        parameters = super().trained_parameters(stage)
        if stage == "1":
            train_lora(self.transformer.base)
        if self.discriminator is not None and stage != "codec":
            self.discriminator.requires_grad_(True)
            parameters |= {name: p for name, p in self.named_parameters() if name.startswith(DISCRIMINATOR)}
        return {name: parameter for name, parameter in parameters.items() if parameter.requires_grad}

    def apply_memory_savings(self, stage: Stage, savings: MemorySavings) -> None:
        """Make training steps cheaper; exact values of frozen weights are kept if the stage saves them."""
        self.frozen = apply_memory_savings(self, stage, savings)

    def add_lora(self, lora: Lora) -> None:
        """Put PEFT's layers into diffusers' transformer; the widening is trained whole."""
        add_lora(self.transformer.base, lora)

    def save_base(self, folder: Path) -> None:
        """Write diffusers' parts and ``world.safetensors``, frozen weights in their exact values."""
        with self.frozen.restored():
            super().save_base(folder)

    def save_lora(self, folder: Path) -> None:
        """Write a LoRA file that diffusers' pipelines load, and ``world.safetensors``."""
        save_lora(self.transformer.base, folder)
        save_world(self.transformer, self.prompt, folder)


def has_cache(transformer: WorldTransformer) -> bool:
    """Whether one of diffusers' caches is enabled, or its hooks are still on the transformer."""
    hooked = any("_diffusers_hook" in vars(module) for module in transformer.modules())
    return hooked or transformer.base._cache_config is not None
