"""Models of RGB alone, which have as many parameters as models with depth."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from persist_backbones.cogvideox.cogvideox import CogVideoX
from persist_cli.api.backbone import Sampling
from tests.support.micro_model import micro, random_clips, shaken


@pytest.fixture
def backbone() -> CogVideoX:
    backbone = micro(depth=False)
    shaken(backbone.transformer)
    return backbone


def test_a_model_without_depth_neither_uses_nor_gives_depth(backbone: CogVideoX) -> None:
    clips = random_clips(1)
    deeper = dataclasses.replace(clips, depth=clips.depth + 1)
    rgb, depth = backbone.generate(clips, Sampling(2))
    assert torch.equal(backbone.generate(deeper, Sampling(2))[0], rgb)
    assert torch.equal(backbone(clips, "1")["loss"], backbone(deeper, "1")["loss"])
    assert torch.equal(depth[:, 0], clips.depth[:, 0])
    assert not depth[:, 1:].any()


def test_a_model_without_depth_reconstructs_the_same_colours_and_no_depth(backbone: CogVideoX) -> None:
    clips = random_clips(1)
    rgb, depth = backbone.reconstruct(clips)
    assert torch.equal(rgb, micro().reconstruct(clips)[0])
    assert depth.shape == clips.depth.shape
    assert not depth.any()


def test_a_model_without_depth_reports_that_it_gives_none(backbone: CogVideoX) -> None:
    assert not backbone.gives_depth
    assert micro().gives_depth


def test_a_model_without_depth_logs_no_loss_of_depth(backbone: CogVideoX) -> None:
    losses = backbone(random_clips(1), "1")
    assert set(losses) == {"loss", "rgb"}
    assert torch.equal(losses["loss"], losses["rgb"])


def test_a_model_without_depth_has_as_many_parameters(backbone: CogVideoX) -> None:
    sizes = {sum(parameter.numel() for parameter in model.parameters()) for model in (backbone, micro())}
    assert len(sizes) == 1
