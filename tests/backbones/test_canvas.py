"""The canvas form: what is drawn reaches the video token it falls on, and nothing else does."""

from __future__ import annotations

import pytest
import torch

from persist_backbones.conditioning import tokens_of
from persist_cli.world.tokens import MemoryTokens
from tests.backbones.micro import CHANNELS, micro, predicted, random_clips, random_tokens, shaken, with_adapter

BEHIND = MemoryTokens(
    torch.full((2, 1, CHANNELS), 0.7),
    torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).expand(2, 1, 3),
    torch.ones(2, 1, dtype=torch.bool),
)


def test_patches_are_in_the_order_of_the_video_tokens() -> None:
    latents = torch.zeros(1, 3, 2, 8, 8)
    latents[0, 1, :, 5, 2] = 1.0  # latent frame 1, row 2 and column 1 of 4 × 4 video tokens
    patches = tokens_of(torch.nn.functional.pixel_unshuffle(latents, 2))
    assert patches.any(-1).nonzero().tolist() == [[0, 16 + 2 * 4 + 1]]


def test_the_mask_of_a_canvas_is_where_tokens_fell() -> None:
    adapter, clips, tokens = with_adapter(micro(), form="canvas").adapter, random_clips(), random_tokens(2, 5)
    assert adapter is not None
    memory = adapter.prepare(tokens, clips.cameras)
    assert memory.mask.shape == memory.tokens.shape[:2] == (2, 3 * 4 * 4)
    assert memory.tokens[~memory.mask].count_nonzero() == 0
    assert memory.tokens[memory.mask].any(-1).all()


@pytest.mark.parametrize("tokens", [None, BEHIND], ids=["none", "behind"])
def test_a_canvas_on_which_nothing_falls_is_stage_one_to_the_bit_even_once_trained(tokens: MemoryTokens | None) -> None:
    backbone, clips = micro(), random_clips()
    shaken(backbone)
    bare = predicted(backbone, clips, None)
    with_adapter(backbone, form="canvas")
    shaken(backbone.adapters)
    assert torch.equal(predicted(backbone, clips, tokens), bare)
