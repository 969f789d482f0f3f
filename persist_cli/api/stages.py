"""The stages of training and their options: parameter groups, memory savings and LoRA."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

if TYPE_CHECKING:  # recipes are read without torch
    import torch
    from torch import nn

Stage = Literal["codec", "1", "2", "policy", "scene-codec", "scene", "scene-outcome"]
STAGES: tuple[Stage, ...] = ("codec", "1", "2")  # of a backbone
SCENE_STAGES: tuple[Stage, ...] = ("scene-codec", "scene", "scene-outcome")  # of a model of scenes


@dataclass(frozen=True)
class ParameterGroup:
    """Some of a model's parameters under a name for people.

    Args:
        name: name of the group, as in tables.
        parameters: parameters by their names in the model.
        new: whether they are initialised at random although others are pretrained.
    """

    name: str
    parameters: Mapping[str, nn.Parameter]
    new: bool = False


@dataclass(frozen=True)
class MemorySavings:
    """Options that make a training step cheaper and change its result by rounding only.

    Args:
        gradient_checkpointing: whether the backward pass computes hidden states of blocks again.
        compile: whether ``torch.compile`` compiles the blocks.
        frozen: precision of the weights that the stage does not train; ``None`` keeps theirs.
        vae_slicing: whether clips are encoded one by one.
    """

    gradient_checkpointing: bool = False
    compile: bool = False
    frozen: torch.dtype | None = None
    vae_slicing: bool = False


@dataclass(frozen=True)
class Distill:
    """The distillation of a trained model to one or two denoising steps, in stages 1 and 2.

    Consistency distillation (Song et al., 2303.01469): between two neighbouring noise levels the teacher makes one
    step, and the student learns to predict the same clean clip on both sides of it. The errors of all channels and
    noise levels count alike: a backbone's weights of them are for denoising.

    Args:
        teacher: checkpoint whose denoising is learned, such as ``reference`` or ``reference#voxel``; null for the
            weights that the run starts from.
        levels: number of noise levels, the steps that the teacher would need from noise to a clip; at most as many as
            the model was trained with.
        guidance: weight of guidance over memory with which the teacher predicts, in stage 2. The student learns its
            result, and needs one prediction a step where the teacher needs two.
        autoguidance: weight of guidance away from the teacher's guide, at least 1; 1 means none. The student learns its
            result and needs no guide.
        loss: how far two clips are from each other: ``huber``, near the absolute error, or ``squared``.
        steps: number of denoising steps that the checkpoint asks for when it is sampled, a divisor of ``levels``.
    """

    teacher: str | None = None
    levels: Annotated[int, Field(ge=2)] = 48
    guidance: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 1.0
    autoguidance: Annotated[float, Field(ge=1, allow_inf_nan=False)] = 1.0
    loss: Literal["huber", "squared"] = "huber"
    steps: Annotated[int, Field(ge=1)] = 1


@dataclass(frozen=True)
class Adversarial:
    """Adversarial training of a model in stages 1 and 2: few denoising steps that leave less blur.

    A discriminator learns to tell the predicted latents of a clip from the true ones, and the model to be taken for
    true, beside its loss of denoising (ADD, Sauer et al., 2311.17042; APT, Lin et al., 2501.08316). It is kept with the
    run's state and is not part of the model.

    Args:
        weight: how strongly the discriminator pulls each predicted clip, as a share of how strongly denoising does.
        steps: number of denoising steps of the sampler ``ddim`` that the checkpoint asks for when it is sampled; the
            model is trained at their noise levels alone.
        learning_rate: of the discriminator; it rises and falls as the model's does.
        penalty: weight of how steep the discriminator's scores are at true and predicted clips (R1 and R2).
        width: number of channels of the discriminator's first layer.
    """

    weight: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 0.3
    steps: Annotated[int, Field(ge=1)] = 8
    learning_rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 3e-4
    penalty: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 10.0
    width: Annotated[int, Field(ge=1)] = 64


@dataclass(frozen=True)
class Lora:
    """A low-rank change that stage 1 trains instead of all weights (LoRA, Hu et al. 2021).

    Args:
        rank: rank of the change of each layer, at least 1.
        alpha: positive; the change is scaled by alpha / rank. ``None`` means alpha = rank.
        targets: final parts of the names of the linear layers that are changed.
    """

    rank: Annotated[int, Field(ge=1)] = 64
    alpha: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    targets: Annotated[tuple[str, ...], Field(min_length=1)] = ("to_q", "to_k", "to_v", "to_out.0")
