"""The texts of --dtype and --save-memory become inference options, or errors of one line."""

from __future__ import annotations

import pytest
import torch

from persist_cli.api.backbone import Backbone
from persist_cli.api.inference import InferenceOptions
from persist_cli.errors import PersistError
from tests.support.micro_model import micro

NO_GPU = pytest.mark.skipif(torch.cuda.is_available(), reason="there is an accelerator")


def test_options_by_name_become_inference_options():
    assert InferenceOptions.of(None, None) == InferenceOptions()
    assert InferenceOptions.of("float16", "vae-tiling, model-offload") == InferenceOptions(
        dtype="float16", offload="model", tiling=True
    )
    assert InferenceOptions.of(None, "sequential-offload,vae-slicing") == InferenceOptions(
        dtype=None, offload="sequential", slicing=True
    )


@pytest.mark.parametrize(
    ("dtype", "save_memory", "cause"),
    [
        ("float8", None, "^unknown --dtype 'float8'; did you mean 'float32'"),
        (None, "offload", "^unknown --save-memory 'offload'; "),
        (None, "vae-slices", "^unknown --save-memory 'vae-slices'; did you mean 'vae-slicing'"),
        (None, "model-offload,sequential-offload", "give one of them$"),
    ],
)
def test_unknown_inference_options_are_refused(dtype, save_memory, cause):
    with pytest.raises(PersistError, match=cause):
        InferenceOptions.of(dtype, save_memory)


def test_changes_of_inference_options_are_only_those_that_change_results():
    assert InferenceOptions.of(None, "model-offload,vae-slicing").changes() == {}
    assert InferenceOptions.of("bfloat16", "vae-tiling").changes() == {"dtype": "bfloat16", "tiling": True}


@NO_GPU
@pytest.mark.parametrize("offload", ["model", "sequential"])
def test_offloading_without_an_accelerator_is_refused(offload):
    cause = rf"^--save-memory {offload}-offload keeps weights .* there is none; leave it"
    with pytest.raises(PersistError, match=cause):
        micro().prepare_inference(InferenceOptions(offload=offload))


def test_by_default_a_backbone_moves_to_the_device_and_saves_no_memory():
    backbone = micro()
    Backbone.prepare_inference(backbone.train(), InferenceOptions(dtype="bfloat16"))
    assert backbone.prompt.dtype == torch.bfloat16
    assert not backbone.training
    with pytest.raises(PersistError, match=r"^backbone 'cogvideox' cannot save memory; leave out --save-memory$"):
        Backbone.prepare_inference(backbone, InferenceOptions(slicing=True))
