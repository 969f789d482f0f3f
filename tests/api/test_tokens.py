"""Memory tokens of several samples in one batch."""

import torch

from persist_cli.api.observations import Origin
from persist_cli.api.tokens import MemoryTokens


def tokens(count, colors=True):
    paint = torch.full((count, 3), count, dtype=torch.uint8) if colors else None
    origins = torch.full((count,), Origin.IMAGINED, dtype=torch.uint8)
    return MemoryTokens.of(torch.ones(count, 4), torch.ones(count, 3), paint, origins, torch.full((count,), 2.0))


def test_a_batch_is_padded_by_tokens_without_colour_and_origin():
    batch = MemoryTokens.stack([tokens(2), MemoryTokens.empty(4), tokens(3)])
    assert batch.colors[:, :, 0].tolist() == [[2, 2, 0], [0, 0, 0], [3, 3, 3]]
    assert batch.origins.tolist() == [[1, 1, 0], [0, 0, 0], [1, 1, 1]]
    assert batch.distances.tolist() == [[2, 2, 0], [0, 0, 0], [2, 2, 2]]
    assert batch.mask.tolist() == [[True, True, False], [False] * 3, [True] * 3]


def test_a_batch_has_colours_when_all_its_samples_have_them():
    assert MemoryTokens.stack([tokens(2), tokens(3, colors=False)]).colors is None


def test_tokens_of_a_memory_that_says_nothing_else_are_observed():
    assert MemoryTokens.of(torch.ones(2, 4), torch.ones(2, 3)).origins.tolist() == [Origin.OBSERVED] * 2


def test_tensors_make_the_same_tokens_again():
    for sample in (tokens(2), tokens(2, colors=False)):
        again = MemoryTokens(**sample.tensors())
        assert sample.tensors().keys() == again.tensors().keys()
        assert all(torch.equal(tensor, again.tensors()[name]) for name, tensor in sample.tensors().items())
