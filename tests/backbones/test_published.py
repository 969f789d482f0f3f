"""The presets against the five published models: every parameter's name and shape, and how many each stage trains."""

import json
from collections.abc import Iterable, Mapping
from typing import Any

import pytest
import torch
from diffusers import AutoencoderKLCogVideoX, CogVideoXTransformer3DModel

from persist_backbones.cogvideox.cogvideox import CogVideoX
from persist_cli.api.stages import STAGES
from persist_cli.plugins import make_backbone
from tests.support.published_configs import SCHEDULERS, TRANSFORMERS, VAES

MODELS = tuple(TRANSFORMERS)
SIZE = {"height": 480, "width": 720, "frames": 49}
VAE_PARAMETERS = 215_583_907
COUNTS = [  # parameters of the published transformer, its widening, and the paper's memory blocks by default
    ("2b", 1_693_783_872, 750_144, 580_737_920),
    ("5b", 5_570_283_072, 1_155_648, 1_891_102_592),
    ("5b-i2v", 5_570_479_680, 959_040, 1_891_102_592),
    ("1.5-5b", 5_570_676_352, 2_237_056, 1_891_231_616),
    ("1.5-5b-i2v", 5_571_594_880, 1_843_840, 1_891_231_616),
]
SAMPLE_SIZES = {"sample_height", "sample_width", "sample_frames"}  # which a preset takes from the settings


def on_meta(preset: str) -> CogVideoX:
    with torch.device("meta"):
        model = make_backbone("cogvideox", {"preset": preset} | SIZE)
    assert isinstance(model, CogVideoX)
    return model


def shapes(module: torch.nn.Module) -> dict[str, torch.Size]:
    return {name: value.shape for name, value in module.state_dict().items()}


def written(config: Mapping[str, Any]) -> dict[str, Any]:
    """A configuration as in its file, without the sizes of clips."""
    values = {key: value for key, value in config.items() if key not in SAMPLE_SIZES and not key.startswith("_")}
    return json.loads(json.dumps(values))


@pytest.mark.parametrize("name", MODELS)
def test_a_preset_has_the_parameters_and_the_configuration_of_the_published_model(name):
    model = on_meta(name)
    with torch.device("meta"):
        transformer, vae = CogVideoXTransformer3DModel(**TRANSFORMERS[name]), AutoencoderKLCogVideoX(**VAES[name])
    assert shapes(model.transformer.base) == shapes(transformer)
    assert shapes(model.codec.vae) == shapes(vae)
    for ours, published in ((model.transformer.base, transformer), (model.codec.vae, vae)):
        assert written(ours.config) == written(published.config)
    assert written(model.scheduler.config) == SCHEDULERS[name]


def count(parameters: Iterable[torch.nn.Parameter]) -> int:
    return sum(parameter.numel() for parameter in parameters)


@pytest.mark.parametrize(("name", "published", "new", "memory"), COUNTS)
def test_the_stages_of_a_preset_train_the_expected_number_of_parameters(name, published, new, memory):
    model = on_meta(name)
    with torch.device("meta"):
        model.add_adapter("voxel", 384, {})
    assert count(model.transformer.base.parameters()) == published
    trained = {stage: count(model.trained_parameters(stage).values()) for stage in STAGES}
    assert trained == {"codec": VAE_PARAMETERS, "1": published + new, "2": memory}
