"""Autoguidance: a video model is sampled away from a weaker version of itself, its guide.

Where a model knows too little it predicts the mean of what may be there, a blur, and a weaker version of it predicts
more of a blur; so what it knows lies in their difference (Karras et al., https://arxiv.org/abs/2406.02507). Here it
acts at the noisier half of the noise levels, which decide what is there; at the others it makes details grainy
(limited intervals: https://arxiv.org/abs/2404.07724).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from persist_backbones.cogvideox.inputs import fit_positions
from persist_backbones.cogvideox.model import Conditions, WorldTransformer, widen
from persist_backbones.cogvideox.parts import load_part, load_world
from persist_cli.errors import CheckpointError

if TYPE_CHECKING:
    from pathlib import Path

    from persist_backbones.cogvideox.cogvideox import CogVideoX

NOISIER = 0.5  # of the noise levels, counted from that without noise: guidance acts from here on


class Autoguidance:
    """What a clip is sampled away from, and how strongly.

    Args:
        model: the model that is sampled.
        guide: a weaker version of its video model.
        weight: how far to go beyond the guide; at 1 it changes nothing.
    """

    def __init__(self, model: CogVideoX, guide: WorldTransformer, weight: float) -> None:
        self.model, self.weight = model, weight
        self.guide = guide.to(model.device, model.prompt.dtype)

    def lead(self, predicted: Tensor, noisy: Tensor, image: Tensor, conditions: Conditions) -> Tensor:
        """Return the model's prediction away from the guide's, in the latents' precision.

        Args:
            predicted: the model's prediction, with its guidance over memory.
            noisy: the noisy latents.
            image: latents of the image condition.
            conditions: all other inputs, which the guide gets too, memory included.
        """
        if not self.acts(self.model.current_timestep):
            return predicted
        model, precision = self.model, self.model.prompt.dtype
        inputs = noisy.to(precision), image.to(precision), conditions
        weaker = self.guide.predict(*inputs, model.shape, model.settings.depth).to(predicted.dtype)
        return weaker + self.weight * (predicted - weaker)

    def acts(self, timestep: Tensor | None) -> bool:
        """Whether a timestep is of a noise level at which guidance acts."""
        levels = int(self.model.scheduler.config.num_train_timesteps)
        return timestep is not None and float(timestep) >= NOISIER * levels


def load_guide(model: CogVideoX, folder: Path) -> WorldTransformer:
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
    load_world(guide, folder)
    return guide.requires_grad_(False).eval()
