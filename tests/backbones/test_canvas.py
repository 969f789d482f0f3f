"""The canvas form: a drawn memory token reaches the video tokens on which it falls, and no others."""

from __future__ import annotations

import pytest
import torch

from persist_backbones.adapters.canvas import CanvasAdapter
from persist_backbones.tensors import tokens_of
from persist_cli.api.tokens import MemoryTokens
from tests.support.micro_model import (
    CHANNELS,
    micro,
    predicted,
    random_clips,
    random_tokens,
    shaken,
    with_adapter,
)
from tests.support.micro_runs import SIZE

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


def test_the_mask_of_a_canvas_marks_where_tokens_fell() -> None:
    adapter, clips, tokens = with_adapter(micro(), form="canvas").adapter, random_clips(), random_tokens(2, 40)
    assert adapter is not None
    memory = adapter.prepare(tokens, clips.cameras)
    assert memory.mask.shape == memory.tokens.shape[:2] == (2, 3 * 4 * 4)
    assert 0 < memory.mask.sum() < memory.mask.numel()
    assert memory.tokens[~memory.mask].count_nonzero() == 0
    assert memory.tokens[memory.mask].any(-1).all()


@pytest.mark.parametrize("head", [0, 8])
@pytest.mark.parametrize("tokens", [None, BEHIND], ids=["none", "behind"])
def test_an_empty_canvas_equals_stage_one_to_the_bit_even_after_training(
    tokens: MemoryTokens | None, head: int
) -> None:
    backbone, clips = micro(), random_clips()
    shaken(backbone)
    bare = predicted(backbone, clips, None)
    with_adapter(backbone, form="canvas", head_width=head)
    shaken(backbone.adapters)
    assert torch.equal(predicted(backbone, clips, tokens), bare)


def test_an_untrained_head_changes_nothing() -> None:
    backbone, clips, tokens = micro(), random_clips(), random_tokens(2, 40)
    shaken(backbone)
    bare = predicted(backbone, clips, None)
    assert torch.equal(predicted(with_adapter(backbone, form="canvas", head_width=8), clips, tokens), bare)


def test_the_head_corrects_only_video_tokens_on_which_a_memory_token_fell() -> None:
    backbone, clips, tokens = micro(), random_clips(), random_tokens(2, 40)
    bare = predicted(backbone, clips, None)
    adapter = with_adapter(backbone, form="canvas", head_width=8).adapter
    assert isinstance(adapter, CanvasAdapter)
    assert adapter.head is not None
    shaken(adapter.head)
    changed = (predicted(backbone, clips, tokens) - bare).ne(0).any(dim=2)
    covered = adapter.prepare(tokens, clips.cameras).mask.reshape(2, 3, 4, 4)
    assert 0 < covered.sum() < covered.numel()
    assert torch.equal(changed, covered.repeat_interleave(2, -1).repeat_interleave(2, -2))


def test_the_head_distinguishes_memory_tokens_within_one_video_token() -> None:
    backbone, clips = micro(), random_clips()
    adapter = with_adapter(backbone, form="canvas", head_width=8, canvas_scale=2, token_size=0.0).adapter
    assert isinstance(adapter, CanvasAdapter)
    assert adapter.head is not None
    place = clips.cameras.intrinsics[0, 0].inverse() @ torch.tensor([SIZE / 2 + 1, SIZE / 2 + 1, 1.0]).double() * 2
    beside = clips.cameras.intrinsics[0, 0].inverse() @ torch.tensor([SIZE / 2 + 5, SIZE / 2 + 1, 1.0]).double() * 2
    prepared_memories = []
    for position in (place, beside):
        token = MemoryTokens(torch.ones(2, 1, CHANNELS), position.expand(2, 1, 3), torch.ones(2, 1, dtype=torch.bool))
        prepared = adapter.prepare(token, clips.cameras)
        assert prepared.seen is not None
        prepared_memories.append((prepared.mask[:, :16], prepared.seen[:, 0]))
    (first_mask, first), (second_mask, second) = prepared_memories
    assert torch.equal(first_mask, second_mask)  # the same video token of the first frame
    assert not torch.equal(first, second)
