"""Autoguidance: a video model is sampled away from a weaker version of itself, its guide.

Where a model knows too little it predicts the mean of what may be there, a blur, and a weaker version of it predicts
more of a blur; so what it knows lies in their difference (Karras et al., https://arxiv.org/abs/2406.02507). Here it
acts at the noisier half of the noise levels, which decide what is there; at the others it makes details grainy
(limited intervals: https://arxiv.org/abs/2404.07724).
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from persist_backbones.cogvideox.inputs import fit_positions
from persist_backbones.cogvideox.model import Conditions, WorldTransformer, widen
from persist_backbones.cogvideox.parts import load_part, load_world
from persist_cli.errors import CheckpointError

if TYPE_CHECKING:
    from pathlib import Path

    from persist_backbones.cogvideox.cogvideox import CogVideoX

NOISIER = 0.5  # of the noise levels, counted from that without noise: guidance acts from here on


class Guide(nn.Module):
    """A weaker version of a video model.

    Args:
        transformer: the version.
        prompt: embedding of the prompt with which it was trained.
    """

    prompt: Tensor

    def __init__(self, transformer: WorldTransformer, prompt: Tensor) -> None:
        super().__init__()
        self.transformer = transformer
        self.register_buffer("prompt", prompt)


class Autoguidance:
    """What a clip is sampled away from, and how strongly.

    Args:
        model: the model that is sampled.
        guide: a weaker version of its video model, which comes to the model's device.
        weight: how far to go beyond the guide; at 1 it changes nothing.
    """

    def __init__(self, model: CogVideoX, guide: Guide, weight: float) -> None:
        self.model, self.weight = model, weight
        self.guide = guide.to(model.device, model.prompt.dtype)

    def lead(self, predicted: Tensor, noisy: Tensor, image: Tensor, conditions: Conditions) -> Tensor:
        """Return the model's prediction away from the guide's, in the latents' precision.

        Args:
            predicted: the model's prediction, with its guidance over memory.
            noisy: the noisy latents.
            image: latents of the image condition.
            conditions: all other inputs, which the guide gets too, memory included, but for the prompt.
        """
        model, guide, precision = self.model, self.guide, self.model.prompt.dtype
        acts = conditions.timestep >= NOISIER * int(model.scheduler.config.num_train_timesteps)
        if not acts.any():
            return predicted
        conditions = dataclasses.replace(conditions, text=guide.prompt.expand(len(noisy), -1, -1))
        inputs = noisy.to(precision), image.to(precision), conditions
        weaker = guide.transformer.predict(*inputs, model.shape, model.settings.depth).to(predicted.dtype)
        return torch.where(acts[:, None, None, None, None], weaker + self.weight * (predicted - weaker), predicted)


def autoguidance_of(model: CogVideoX, weight: float, guides: dict[Path, Guide]) -> Autoguidance | None:
    """Return a model's guidance away from its guide; ``None`` where there is none, or the weight asks for none.

    Args:
        model: the model that is sampled.
        weight: how far to go beyond the guide.
        guides: those that were loaded, by folder; a guide that is not among them is loaded, and kept there.
    """
    folder = model.guide_folder
    if weight == 1 or folder is None:
        return None
    if folder not in guides:
        guides[folder] = load_guide(model, folder)
    return Autoguidance(model, guides[folder], weight)


def load_guide(model: CogVideoX, folder: Path) -> Guide:
    """Load the guide of a model, whose codec and shape of clips it shares.

    Raises:
        CheckpointError: when a file is missing or corrupt, or the guide has other sizes than the model.
    """
    transformer = load_part(folder, "transformer")
    own = model.transformer.base.config
    changed = [name for name, value in own.items() if not name.startswith("_") and transformer.config[name] != value]
    if changed:
        raise CheckpointError(f"{folder}: the guide's transformer has another {changed[0]} than the model")
    fit_positions(transformer, (model.shape.padded_frames, model.shape.height, model.shape.width))
    with torch.random.fork_rng(devices=[]):
        guide = widen(transformer, model.codec.vae, model.settings, model.shape)
    return Guide(guide, load_world(guide, folder)).requires_grad_(False).eval()
