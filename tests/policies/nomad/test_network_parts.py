"""The parts of NoMaD's network by themselves: padding, embeddings, noise, dropping; and what a policy asks of it."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from persist_cli.api.ground import GroundMap
from persist_cli.api.policy import Goal, Situation
from persist_cli.api.policy_network import SampleForm
from persist_cli.policies.nomad.efficientnet import Convolution
from persist_cli.policies.nomad.network import NomadNetwork, sinusoids_interleaved
from persist_cli.policies.nomad.unet import sinusoids
from persist_cli.policies.open_policy import open_policy
from persist_cli.policies.trained import save_policy
from tests.support.micro_policies import micro_network, random_samples
from tests.support.room_worlds import room_info, room_views
from tests.support.rooms import UP, look

SEEN = torch.zeros(4, dtype=torch.bool)  # no goal is masked


def test_of_an_odd_number_of_padded_pixels_more_go_below_and_to_the_right():
    convolution, image = Convolution(1, 1, 3, 2), torch.arange(24.0).view(1, 1, 4, 6)
    torch.nn.init.ones_(convolution.weight)
    padded = torch.nn.functional.pad(image, (0, 1, 0, 1))
    sums = [[float(padded[0, 0, y : y + 3, x : x + 3].sum()) for x in (0, 2, 4)] for y in (0, 2)]
    assert convolution(image)[0, 0].tolist() == sums


def test_a_noise_level_is_embedded_as_sines_and_then_cosines_of_waves_up_to_ten_thousand_long():
    angles = [3.0, 3.0 / 10_000 ** (1 / 3), 3.0 / 10_000 ** (2 / 3), 3.0 / 10_000]
    expected = [*map(math.sin, angles), *map(math.cos, angles)]
    assert sinusoids(torch.tensor([3]), 8)[0].tolist() == pytest.approx(expected, abs=1e-6)


def test_the_place_of_a_token_is_embedded_as_sine_and_cosine_side_by_side():
    places = sinusoids_interleaved(4, 4)
    assert places[0].tolist() == [0.0, 1.0, 0.0, 1.0]
    expected = [math.sin(3), math.cos(3), math.sin(0.03), math.cos(0.03)]
    assert places[3].tolist() == pytest.approx(expected, abs=1e-6)


def test_images_are_resized_to_the_height_and_width_of_the_settings():
    network, samples = micro_network(height=32, width=64), random_samples(size=48)
    shapes: list[torch.Size] = []
    network.goal_encoder.register_forward_pre_hook(lambda module, images: shapes.append(images[0].shape))
    network.condition(samples.seen, samples.goal, SEEN)
    assert shapes == [(4, 6, 32, 64)]


def test_at_the_last_noise_level_nothing_is_left_of_the_motions_and_at_the_first_nearly_all():
    kept = micro_network().scheduler.alphas_cumprod.sqrt()
    assert float(kept[0]) > 0.97
    assert float(kept[-1]) < 0.01


def test_sampled_motions_are_never_larger_than_those_that_are_learned():
    network, samples = micro_network(), random_samples()
    torch.nn.init.constant_(network.noise.out.bias, 30.0)
    condition = network.condition(samples.seen, samples.goal, SEEN)[0].detach()
    ways = network.sample(condition, 8, 10, torch.Generator().manual_seed(0))
    motions = torch.diff(ways, dim=1, prepend=torch.zeros(8, 1, 2))
    assert float(motions.abs().max()) <= 0.4 + 1e-5  # least and most are -1 and 1 of 0.4 m


def test_features_are_dropped_in_training_alone_as_often_as_the_settings_say():
    network, samples = micro_network(dropout=0.75), random_samples()
    shares: list[float] = []
    for part in (network.seen_token, network.goal_token):
        part.register_forward_pre_hook(lambda module, given: shares.append(float((given[0] == 0).double().mean())))
    for training in (True, False):
        network.train(training).condition(samples.seen, samples.goal, SEEN)
    assert shares == [pytest.approx(0.75, abs=0.15)] * 2 + [0.0] * 2


def test_blocks_of_both_encoders_are_left_out_as_often_as_the_settings_say():
    network = micro_network(drop_blocks=0.4)
    drops = [[block.drop for block in encoder.blocks] for encoder in (network.seen_encoder, network.goal_encoder)]
    assert drops == [[0.0, 0.2]] * 2


def test_samples_have_the_form_that_the_settings_say():
    network = micro_network(context=2, waypoints=4, spacing=3, farthest=9, nearest=5, negatives=0.25)
    assert network.sample_form == SampleForm(2, 4, 3, 9, 5, 0.25)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A policy that nobody trained."""
    save_policy(micro_network(context=2), "nomad", tmp_path, None)
    return tmp_path


@pytest.fixture
def situation() -> Situation:
    """An agent that has turned for seven frames."""
    seen = room_views(*(look((0.0, 1.25, 0.0), 15.0 * number, 0.0) for number in range(7)))
    return Situation(seen, room_info(), Goal(seen.rgb[0], None, "room"), GroundMap.empty(UP))


def test_a_policy_shows_its_network_the_past_first_and_the_present_last(folder, situation, monkeypatch):
    policy, given = open_policy(str(folder)), []
    condition = NomadNetwork.condition
    monkeypatch.setattr(
        NomadNetwork,
        "condition",
        lambda network, seen, *others: given.append(seen) or condition(network, seen, *others),
    )
    policy.distance(situation)
    assert torch.equal(given[0].cpu()[0], situation.seen.rgb[[2, 4, 6]])


def test_a_policy_takes_as_many_denoising_steps_as_its_settings_say(folder, situation):
    for steps, taken in ((3, 3), (None, 10)):
        policy, calls = open_policy(str(folder), {"stop": 0, "steps": steps}), []
        policy.network.noise.register_forward_hook(lambda *_, calls=calls: calls.append(1))
        policy.propose(situation, 4, 2, torch.Generator().manual_seed(0))
        assert len(calls) == taken
