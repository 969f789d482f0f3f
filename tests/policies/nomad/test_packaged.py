"""The policy that comes with the package is whole, small, and knows where a goal lies."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from persist_cli.api.policy_network import PolicySamples
from persist_cli.data.reference import sample_data
from persist_cli.policies.nomad.network import NomadNetwork, squashed
from persist_cli.policies.trained import TrainedPolicy, packaged_policy
from tests.benchmarks.bench_policy import moments
from tests.support.packaged_models import check_files, check_sample_is_unseen

MOST_BYTES = 10e6


@pytest.fixture
def packaged(monkeypatch) -> TrainedPolicy:
    """The one in the package; other tests have none, or use their own."""
    monkeypatch.delenv("PERSIST_REFERENCE")
    return packaged_policy()


def test_every_file_has_its_hash_and_all_are_small(packaged):
    check_files(packaged.folder, MOST_BYTES)


def test_it_was_not_trained_on_the_sample_houses(packaged):
    check_sample_is_unseen(packaged.training_scenes)


def test_it_knows_better_where_a_goal_lies_when_it_sees_that_goal_than_when_it_sees_another(packaged):
    network = packaged.load()
    samples = moments(network, [sample_data()], 64, seed=0)
    others = torch.randperm(64, generator=torch.Generator().manual_seed(0))
    assert error_of_place(network, samples, samples.goal) < 0.9 * error_of_place(network, samples, samples.goal[others])


def error_of_place(network: NomadNetwork, samples: PolicySamples, goal: Tensor) -> float:
    """Return the mean squared error of where the goals of the samples lie, if these images are shown."""
    with torch.no_grad():
        condition = network.condition(samples.seen, goal, torch.zeros(len(goal), dtype=torch.bool))
        return float((network.place(condition) - squashed(samples.goal_place)).square().mean())
