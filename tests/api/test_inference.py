"""What --dtype and --save-memory ask for."""

from __future__ import annotations

import pytest
import torch

from persist_cli.api.backbone import Backbone
from persist_cli.api.inference import Placement
from persist_cli.errors import PersistError
from tests.support.micro_model import micro

NO_GPU = pytest.mark.skipif(torch.cuda.is_available(), reason="there is an accelerator")


def test_words_become_a_placement():
    assert Placement.of(None, None) == Placement()
    assert Placement.of("float16", "vae-tiling, model-offload") == Placement("float16", "model", tiling=True)
    assert Placement.of(None, "sequential-offload,vae-slicing") == Placement(None, "sequential", slicing=True)


@pytest.mark.parametrize(
    ("dtype", "save_memory", "cause"),
    [
        ("float8", None, "^unknown --dtype 'float8'; did you mean 'float32'"),
        (None, "offload", "^unknown --save-memory 'offload'; "),
        (None, "vae-slices", "^unknown --save-memory 'vae-slices'; did you mean 'vae-slicing'"),
        (None, "model-offload,sequential-offload", "give one of them$"),
    ],
)
def test_other_words_are_one_line(dtype, save_memory, cause):
    with pytest.raises(PersistError, match=cause):
        Placement.of(dtype, save_memory)


def test_only_what_changes_results_is_told_apart():
    assert Placement.of(None, "model-offload,vae-slicing").changes() == {}
    assert Placement.of("bfloat16", "vae-tiling").changes() == {"dtype": "bfloat16", "tiling": True}


@NO_GPU
@pytest.mark.parametrize("offload", ["model", "sequential"])
def test_offloading_without_an_accelerator_is_one_line(offload):
    with pytest.raises(
        PersistError, match=rf"^--save-memory {offload}-offload keeps weights .* there is none; leave it"
    ):
        micro().place(Placement(offload=offload))


def test_a_backbone_that_says_no_more_moves_and_saves_no_memory():
    backbone = micro()
    Backbone.place(backbone.train(), Placement("bfloat16"))
    assert backbone.prompt.dtype == torch.bfloat16
    assert not backbone.training
    with pytest.raises(PersistError, match=r"^backbone 'cogvideox' cannot save memory; leave out --save-memory$"):
        Backbone.place(backbone, Placement(slicing=True))
