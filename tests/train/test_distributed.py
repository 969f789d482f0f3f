"""What processes that train together agree on, and what is said when one is lost; runs of several are elsewhere."""

from __future__ import annotations

from contextlib import suppress
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import nn

from persist_cli.errors import PersistError
from persist_cli.train.distributed import explain_lost_processes, fsdp_plugin, unflattened
from persist_cli.train.trainer import Trainer


def test_sharded_weights_are_used_in_bf16_and_their_gradients_summed_in_float32(monkeypatch):
    for name, value in {"ACCELERATE_USE_FSDP": "true", "FSDP_VERSION": "2"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("FSDP_CPU_RAM_EFFICIENT_LOADING", "true")  # as of the launcher; the plugin changes it
    half = fsdp_plugin("bf16").mixed_precision_policy
    assert (half.param_dtype, half.reduce_dtype) == (torch.bfloat16, torch.float32)
    assert not half.cast_forward_inputs  # noise levels and positions stay exact
    exact = fsdp_plugin("no").mixed_precision_policy
    assert exact is None or (exact.param_dtype, exact.reduce_dtype) == (None, None)


def test_only_errors_of_the_connection_are_taken_for_a_lost_process():
    with pytest.raises(RuntimeError, match=r"^shapes differ$"), explain_lost_processes(lambda: "go on"):
        raise RuntimeError("shapes differ")
    lost = r"^process 0 of 1 lost another one, .*; a checkpoint is whole$"
    for error in (RuntimeError("[../gloo/transport/tcp/pair.cc] closed"), torch.distributed.DistNetworkError("gone")):
        with pytest.raises(PersistError, match=lost), explain_lost_processes(lambda: "a checkpoint is whole"):
            raise error


@pytest.mark.parametrize(
    ("own", "other", "agreed"),
    [
        ((False, None), (0, 0), (False, None)),
        ((True, None), (0, 0), (True, None)),
        ((False, None), (1, 0), (True, None)),
        ((False, 15), (0, 0), (False, 15)),
        ((False, None), (0, 2), (False, 2)),
    ],
)
def test_processes_save_and_stop_together_when_any_is_to(own, other, agreed):
    def gather(flags: torch.Tensor) -> torch.Tensor:
        return torch.cat([flags, torch.tensor([other])])

    both: Any = SimpleNamespace(num_processes=2, device=torch.device("cpu"), gather=gather)
    assert Trainer.agreed(SimpleNamespace(accelerator=both), *own) == agreed


def test_pieces_of_one_tensor_have_memory_of_their_own_while_they_are_saved():
    whole = torch.arange(5.0)
    weights = [nn.Parameter(torch.empty(0)) for _ in range(2)]
    weights[0].data, weights[1].data = whole[:2], whole[2:]
    with suppress(OSError), unflattened(weights):
        assert [weight.untyped_storage().nbytes() for weight in weights] == [8, 12]
        assert torch.cat([weight.data for weight in weights]).tolist() == [0, 1, 2, 3, 4]
        raise OSError("full")
    whole += 1
    assert torch.cat([weight.data for weight in weights]).tolist() == [1, 2, 3, 4, 5]
