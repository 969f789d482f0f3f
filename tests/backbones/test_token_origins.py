"""Origins of tokens: an adapter may learn which of them were imagined, and those without it stay as they were."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from torch import nn

from persist_backbones.cogvideox.cogvideox import CogVideoX
from persist_cli.api.observations import Origin
from persist_cli.api.tokens import MemoryTokens
from tests.support.micro_model import (
    POINT_FORMS,
    micro,
    predicted,
    random_clips,
    random_tokens,
    shaken,
    with_adapter,
)

every_form = pytest.mark.parametrize("form", POINT_FORMS)


def imagined(tokens: MemoryTokens) -> MemoryTokens:
    """The same tokens, all of them imagined."""
    return dataclasses.replace(tokens, origins=torch.full_like(tokens.origins, Origin.IMAGINED))


def trained(form: str) -> tuple[CogVideoX, nn.Parameter]:
    """A micro model with an adapter as if trained, but its embedding of what was imagined, which is zero."""
    backbone = with_adapter(micro(), form=form, origins=True)
    shaken(backbone)
    embedding = backbone.get_parameter(next(name for name, _ in backbone.named_parameters() if "imagined" in name))
    nn.init.zeros_(embedding)
    return backbone, embedding


def loss_of(backbone: CogVideoX, tokens: MemoryTokens) -> torch.Tensor:
    """The loss of a training step of stage 2."""
    loss: torch.Tensor = backbone(random_clips(tokens=tokens), "2")["loss"]
    return loss


@every_form
def test_a_trained_embedding_tells_imagined_tokens_from_observed_ones(form: str) -> None:
    backbone, embedding = trained(form)
    clips, observed = random_clips(), random_tokens(2, 60)  # so many that some are hidden from view by others
    seen, invented = (predicted(backbone, clips, tokens) for tokens in (observed, imagined(observed)))
    with torch.no_grad():
        embedding.copy_(torch.linspace(-1, 1, len(embedding)))
    assert torch.equal(predicted(backbone, clips, observed), seen)
    assert not torch.allclose(predicted(backbone, clips, imagined(observed)), invented, atol=1e-4)


@pytest.mark.parametrize("form", [form for form in POINT_FORMS if form != "rendered"])  # its views tell origins anyway
def test_a_fresh_embedding_changes_no_bit(form: str) -> None:
    backbone, _ = trained(form)
    clips, tokens = random_clips(), random_tokens(2, 60)
    assert torch.equal(predicted(backbone, clips, imagined(tokens)), predicted(backbone, clips, tokens))


@every_form
def test_the_embedding_learns_from_imagined_tokens_alone(form: str) -> None:
    backbone, embedding = trained(form)
    loss_of(backbone, random_tokens(2, 60)).backward()
    assert embedding.grad is not None
    assert not embedding.grad.any()
    loss_of(backbone, imagined(random_tokens(2, 60))).backward()
    assert embedding.grad.any()


@every_form
def test_an_adapter_whose_card_does_not_know_of_origins_loads_to_the_bit(form: str, tmp_path: Path) -> None:
    backbone = with_adapter(micro(), form=form)
    shaken(backbone)
    backbone.save_adapter(tmp_path)
    card = json.loads((tmp_path / "adapter.json").read_text())
    assert card.pop("origins") is False
    (tmp_path / "adapter.json").write_text(json.dumps(card))
    clips, tokens = random_clips(), imagined(random_tokens(2, 60))
    before = predicted(backbone, clips, tokens)
    backbone.load_adapter("old", tmp_path)
    assert torch.equal(predicted(backbone, clips, tokens), before)
    assert not [name for name, _ in backbone.adapters["old"].named_parameters() if "imagined" in name]
