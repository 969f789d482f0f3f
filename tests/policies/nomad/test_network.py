"""NoMaD's network: its sizes, what it depends on, and what it learns."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import nn

from persist_cli.api.meta_device import without_weights
from persist_cli.api.policy_network import PolicySamples
from persist_cli.errors import CheckpointError, RecipeError
from persist_cli.io.settings import parse_settings
from persist_cli.policies.nomad.efficientnet import Block, EfficientNet, EncoderSettings
from persist_cli.policies.nomad.matcher import Matcher
from persist_cli.policies.nomad.network import NomadNetwork, NomadNetworkSettings, squashed
from tests.support.micro_policies import micro_network, random_samples

NO = torch.zeros(4, dtype=torch.bool)


def test_the_published_sizes_have_the_published_number_of_parameters():
    with without_weights():
        network = NomadNetwork(NomadNetworkSettings())
    sizes = {group.name: sum(map(torch.numel, group.parameters.values())) for group in network.parameter_groups()}
    assert sizes["seen_encoder"] == 5_288_548 - 1000 * 1281  # EfficientNet-B0 without its classifier
    assert sizes["goal_encoder"] == sizes["seen_encoder"] + 3 * 32 * 9  # three more channels of the image
    assert sum(sizes.values()) == sum(map(torch.numel, network.parameters()))


def test_a_masked_goal_changes_nothing_when_its_image_changes():
    network, samples = micro_network(), random_samples()
    masked = torch.tensor([True, False, True, False])
    first = network.condition(samples.seen, samples.goal, masked)
    second = network.condition(samples.seen, samples.goal.flip(0), masked)
    assert torch.equal(first[masked], second[masked])
    assert not torch.isclose(first[~masked], second[~masked]).all(1).any()


def test_the_goal_is_compared_with_the_present_frame_in_the_colours_of_imagenet():
    network, samples = micro_network(), random_samples()
    given: list[torch.Tensor] = []
    network.goal_encoder.register_forward_pre_hook(lambda module, images: given.extend(images))
    network.condition(samples.seen, samples.goal, NO)
    mean, deviation = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    for image, part in zip((samples.seen[:, -1], samples.goal), given[0].chunk(2, dim=1), strict=True):
        assert torch.allclose(part.permute(0, 2, 3, 1), (image / 255 - mean) / deviation, atol=1e-6)


def test_the_condition_is_the_mean_over_the_tokens_that_are_not_masked():
    network, samples = micro_network(), random_samples()
    given: list[torch.Tensor] = []

    class Kept(nn.Module):
        def forward(self, tokens, src_key_padding_mask):
            given.append(tokens)
            return tokens

    network.transformer = Kept()
    masked = torch.tensor([True, False, False, False])
    condition = network.condition(samples.seen, samples.goal, masked)
    assert torch.allclose(condition[1:], given[0][1:].mean(1), atol=1e-6)
    without_goal = torch.cat([given[0][:1, :-1], torch.zeros_like(given[0][:1, -1:])], dim=1)
    assert torch.allclose(condition[:1], without_goal.mean(1) * 3 / 2, atol=1e-6)  # (context + 2) / (context + 1)


def test_motions_are_scaled_as_published():
    published = NomadNetworkSettings(metres=0.25)
    network = micro_network(least=published.least, most=published.most, metres=0.25)
    straight = torch.arange(1, 5)[None, :, None] * torch.tensor([0.25, 0.0])
    motions = network.normalised(straight)
    assert torch.allclose(motions, torch.tensor([3.5 / 7.5 * 2 - 1, 0.0]).expand(1, 4, 2), atol=1e-6)
    assert torch.allclose(network.waypoints(motions), straight, atol=1e-6)


def test_the_loss_weighs_the_distance_by_one_in_ten_thousand():
    losses = micro_network()(random_samples(), "policy")
    assert torch.isclose(losses["loss"], 1e-4 * losses["distance_error"] + (1 - 1e-4) * losses["noise_error"])


MATCHER = {"stem": 8, "stages": [[1, 8, 1, 2, 3]], "head": 16}


def test_the_error_of_the_goals_place_is_learned_where_the_goal_is_seen_and_its_place_known():
    network, samples = micro_network(place_weight=0.5, masked=0.0, matcher=MATCHER), random_samples()
    losses = network(samples, "policy")
    rest = 1e-4 * losses["distance_error"] + (1 - 1e-4) * losses["noise_error"]
    assert torch.isclose(losses["loss"], rest + 0.5 * losses["place_error"])
    unknown = samples.goal_place.clone()
    unknown[0] = 0
    moved = unknown.clone()
    moved[0, 0] = 100.0  # metres of no goal
    errors = [
        network(dataclasses.replace(samples, goal_place=one), "policy")["place_error"] for one in (unknown, moved)
    ]
    assert errors[0] == errors[1]
    assert errors[0] != losses["place_error"]
    assert "place_error" not in micro_network()(samples, "policy")


def test_the_predicted_place_of_a_goal_is_in_metres_and_says_how_certain_its_heading_is():
    network = micro_network(place_weight=0.5, matcher=MATCHER)
    condition = network.condition(random_samples().seen, random_samples().goal, torch.zeros(4, dtype=torch.bool))[0]
    assert network.place is not None
    torch.nn.init.zeros_(network.place[-1].weight)
    network.place[-1].bias.data = squashed(torch.tensor([[3.0, -4.0, 0.0, 0.5]]))[0]
    place = network.goal_place(condition)
    assert place is not None
    found = [place.ahead, place.left, place.metres, place.heading, place.certainty]
    assert found == pytest.approx([3.0, -4.0, 5.0, 90.0, 0.5], rel=1e-5)
    network.place[-1].bias.data = torch.tensor([0.9, 0.9, 1.0, 0.0])  # farther than anything
    assert network.goal_place(condition).metres == pytest.approx(50)
    assert micro_network().goal_place(condition) is None


def test_a_matcher_finds_each_place_of_an_image_where_it_has_gone_in_another():
    torch.manual_seed(0)
    matcher = Matcher(parse_settings(EncoderSettings, MATCHER, "the matcher"), (32, 32))
    image = torch.randn(1, 3, 32, 32)
    gone = image.roll(4, dims=3)  # a place is four pixels wide
    first, second = (matcher.encoder.map(one).flatten(2).transpose(1, 2) for one in (image, gone))
    place = matcher.found(first, second)[0].argmax(1).view(8, 8)
    columns = place[1:-1, 1:-2] % 8  # the border is padded
    assert torch.equal(columns, torch.arange(2, 7).expand(6, 5))
    assert matcher(torch.cat([image, gone], dim=1)).shape == (1, matcher.width)


def test_waypoints_that_do_not_lead_to_the_goal_or_stand_still_are_not_learned():
    network, samples = micro_network(still=0.5), random_samples()
    moved = samples.waypoints.clone()
    moved[0] = 0.3
    elsewhere = dataclasses.replace(samples, leads_to_goal=torch.tensor([False, True, True, True]))
    changed = dataclasses.replace(elsewhere, waypoints=moved)
    assert torch.equal(network(elsewhere, "policy")["noise_error"], network(changed, "policy")["noise_error"])
    still = dataclasses.replace(samples, waypoints=moved)  # 0.42 m
    assert torch.equal(network(elsewhere, "policy")["noise_error"], network(still, "policy")["noise_error"])
    moved[0, 1] = 0.4  # goes there and back
    back = dataclasses.replace(samples, waypoints=moved)
    assert not torch.equal(network(elsewhere, "policy")["noise_error"], network(back, "policy")["noise_error"])


def test_of_a_masked_goal_neither_the_distance_nor_the_place_is_learned():
    losses = micro_network(masked=1.0, place_weight=0.5, matcher=MATCHER)(random_samples(), "policy")
    assert losses["distance_error"] == losses["place_error"] == 0


def test_every_noise_level_is_learned_and_so_many_goals_are_masked():
    masked, levels, noise = micro_network(masked=0.3)._draw(range(400))
    assert set(levels.tolist()) == set(range(10))
    assert float(masked.double().mean()) == pytest.approx(0.3, abs=0.08)
    assert float(noise.std()) == pytest.approx(1.0, abs=0.05)


def test_blocks_are_left_out_in_training_the_later_the_more_often_and_count_more_where_they_are_not():
    torch.manual_seed(0)
    settings = parse_settings(EncoderSettings, {"stem": 8, "stages": [[1, 8, 4, 1, 3]], "head": 16}, "the encoder")
    assert [block.drop for block in EfficientNet(settings, 3, 0.2).blocks] == pytest.approx([0.0, 0.05, 0.1, 0.15])
    block, image = Block(8, (1, 8, 1, 1, 3), 0.25), torch.randn(64, 8, 4, 4)
    added = block.eval()(image) - image
    changes = (block.train()(image) - image).detach()
    left_out = changes.flatten(1).abs().amax(1) == 0
    assert 4 <= int(left_out.sum()) <= 30
    assert torch.allclose(changes[~left_out], added[~left_out] / 0.75, atol=1e-5)


def test_what_is_random_about_a_sample_follows_from_its_seed_whatever_the_batch():
    network, samples = micro_network(masked=0.0), random_samples()
    half = dataclasses.replace(
        samples.to("cpu"), seen=samples.seen[2:], goal=samples.goal[2:], waypoints=samples.waypoints[2:],
        distance=samples.distance[2:], leads_to_goal=samples.leads_to_goal[2:], seeds=samples.seeds[2:],
    )  # fmt: skip
    whole, part = network._draw(samples.seeds), network._draw(half.seeds)
    assert all(torch.equal(one[2:], other) for one, other in zip(whole, part, strict=True))
    assert torch.isfinite(network(half, "policy")["loss"])


def test_a_network_that_overfits_one_sample_gives_its_waypoints():
    network, samples = micro_network(masked=0.0), random_samples(1)
    curve = torch.tensor([[[0.3, 0.1], [0.5, 0.3], [0.6, 0.6], [0.6, 0.9]]])
    optimizer, losses = torch.optim.AdamW(network.parameters(), 3e-3), list[float]()
    for step in range(80):
        loss = network(repeated(dataclasses.replace(samples, waypoints=curve), 32, step), "policy")["loss"]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert sum(losses[-5:]) < 0.2 * sum(losses[:5])
    condition = network.condition(samples.seen, samples.goal, NO[:1])[0].detach()
    ways = network.sample(condition, 8, 10, torch.Generator().manual_seed(0))
    assert (ways - curve).norm(dim=-1).mean() < 0.2


def repeated(sample: PolicySamples, count: int, step: int) -> PolicySamples:
    """A batch of one sample so often, each with noise of its own."""
    names = ("seen", "goal", "waypoints", "distance", "goal_place", "leads_to_goal")
    parts = {name: getattr(sample, name) for name in names}
    many = {name: part.expand(count, *part.shape[1:]) for name, part in parts.items()}
    return PolicySamples(**many, seeds=range(step * count, (step + 1) * count))


def test_saved_weights_give_the_same_samples_to_the_bit(tmp_path):
    network, samples = micro_network(), random_samples()
    network.save(tmp_path)
    torch.manual_seed(9)
    other = NomadNetwork(network.settings).eval()
    other.load(tmp_path)
    ways = []
    for one in (network, other):
        condition = one.condition(samples.seen, samples.goal, NO)[0].detach()
        ways.append(one.sample(condition, 3, 10, torch.Generator().manual_seed(0)))
    assert torch.equal(*ways)


def test_weights_of_another_size_are_refused(tmp_path):
    micro_network().save(tmp_path)
    with pytest.raises(CheckpointError, match="does not fit this model"):
        micro_network(tokens=32).load(tmp_path)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"waypoints": 7}, "waypoints 7 cannot be halved"),
        ({"channels": [12]}, r"channels \[12\] must be multiples of 8"),
        ({"tokens": 24}, "tokens 24 must be a multiple of 16"),
        ({"least": [5.0, 1.0]}, "must be below most"),
        ({"nearest": 8}, "nearest 8 must be below farthest 8"),
        ({"waypoint": 8}, "did you mean 'waypoints'"),
    ],
)
def test_sizes_that_do_not_go_together_are_refused_in_one_line(settings, message):
    with pytest.raises(RecipeError, match=message):
        parse_settings(NomadNetworkSettings, {"channels": [8, 16], "farthest": 8} | settings, "the network")
