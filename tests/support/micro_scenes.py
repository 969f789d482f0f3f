"""A micro model of scenes, and samples of windows of random rooms for it."""

from __future__ import annotations

from functools import cache
from typing import Any

import torch

from persist_cli.api.scene_model import SceneForm, SceneSamples
from persist_cli.io.settings import parse_settings
from persist_memory.scene_models.scene_diffusion import SceneDiffusion
from persist_memory.scene_models.settings import SceneDiffusionSettings
from tests.support.random_scenes import PALETTE, random_sample

MICRO_SCENE: dict[str, Any] = {
    "palette": PALETTE, "shape": [16, 16, 8], "image": [16, 16],
    "codec": {"embedding": 4, "channels": [16, 16], "latent": 8, "cell": 8},
    "transformer": {"layers": 1, "width": 16, "heads": 2, "region": 2},
}  # fmt: skip


def micro_model(seed: int = 0, **settings: Any) -> SceneDiffusion:
    """Make a micro model with weights of a seed."""
    torch.manual_seed(seed)
    return SceneDiffusion(parse_settings(SceneDiffusionSettings, MICRO_SCENE | settings, "the micro model")).eval()


@cache
def micro_samples(count: int, form: SceneForm | None = None, stacked: bool = True) -> Any:
    """Make samples of windows of random rooms, as a batch or one by one."""
    form = form or parse_settings(SceneDiffusionSettings, MICRO_SCENE, "the micro model").form
    samples = [random_sample(form, seed) for seed in range(count)]
    return SceneSamples.stack(samples) if stacked else samples
