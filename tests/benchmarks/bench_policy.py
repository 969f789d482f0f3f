"""What the ways of a trained policy follow from: its goal, or what it sees alone.

    python tests/benchmarks/bench_policy.py --policy runs/policy --data runs/houses-test

Prints a table, asserts nothing; ``--out`` keeps it as ``policy.json``. Moments of the data have a goal that the walk
came to later. The policy is asked with that goal, with the goal of another moment, and without one. For the walk's last
waypoint, ahead and to the side, the table has its correlation over all moments with the mean over sampled ways; for the
distance, that with the predicted one. A policy that takes no notice of its goal has the same in all rows.

A second table says how well it knows where a goal lies: goals are any frames up to 5 m away in the same walk, most of
which the present frame does not show. Metres and degrees are medians; *sure* are those of which it is sure enough to go
there (``sure`` of ``nomad``). What is always predicted at the agent's place is wrong by the metres of *nothing known*.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_cli.api.policy_network import PolicySample, PolicySamples
from persist_cli.data.policy_samples import PolicySampleDataset, SampleFrames
from persist_cli.data.reference import sample_data
from persist_cli.io.files import write_json
from persist_cli.output.console import print_table, say
from persist_cli.policies.nomad.network import NomadNetwork
from persist_cli.policies.nomad.policy import SURE
from persist_cli.policies.trained import find_policy, packaged_policy

BATCH = 50
FARTHEST = 5.0  # metres to a goal whose place is asked for


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print the table and write what ``--out`` asks for."""
    options = parse(arguments)
    trained = packaged_policy() if options.policy is None else find_policy(options.policy)
    network = trained.load()
    assert isinstance(network, NomadNetwork), f"{trained.folder}: of policy {trained.plugin!r}, not 'nomad'"
    data = options.data or [sample_data()]
    samples = moments(network, data, options.moments, options.seed)
    others = torch.randperm(len(samples.goal), generator=torch.Generator().manual_seed(options.seed))
    hidden = torch.ones(len(others), dtype=torch.bool)
    with torch.no_grad():
        rows = {
            "its goal": correlations(network, samples, samples.goal, ~hidden, options.ways),
            "another goal": correlations(network, samples, samples.goal[others], ~hidden, options.ways),
            "no goal": correlations(network, samples, samples.goal, hidden, options.ways),
        }
    say(f"{trained.folder}: {len(others)} moments of {', '.join(map(str, options.data or ['sample']))}")
    print_table(
        "correlation with what the walk did", ["asked with", "ahead", "to the side", "distance"],
        [[name, *(f"{value:.2f}" for value in row.values())] for name, row in rows.items()],
    )  # fmt: skip
    places = place_errors(network, data, options.moments, options.seed)
    print_table("where a goal lies", [*places], [[f"{value:.2f}" for value in places.values()]])
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        write_json(
            options.out / "policy.json",
            {"policy": trained.fingerprint, "moments": len(others), "rows": rows, "places": places},
        )


def moments(network: NomadNetwork, data: Sequence[Path], count: int, seed: int) -> PolicySamples:
    """Return moments whose waypoints lead to the goal and do not stand still."""
    dataset = PolicySampleDataset(data, network.sample_form, seed)
    kept: list[PolicySample] = []
    number = 0
    while len(kept) < count:
        sample, number = dataset[number], number + 1
        if sample.leads_to_goal and float(sample.waypoints.norm(dim=-1).max()) >= network.settings.still:
            kept.append(sample)
    return PolicySamples.stack(kept)


def correlations(
    network: NomadNetwork, samples: PolicySamples, goal: Tensor, hidden: Tensor, ways: int
) -> dict[str, float]:
    """Return the correlations of the last waypoint and of the distance with the true ones."""
    last, distance = [], []
    for first in range(0, len(goal), BATCH):
        part = slice(first, first + BATCH)
        conditions = network.condition(samples.seen[part], goal[part], hidden[part])
        distance.append(network.distance(conditions)[:, 0])
        for number, condition in enumerate(conditions, start=first):
            generator = torch.Generator().manual_seed(number)
            sampled = network.sample(condition, ways, network.settings.noise_levels, generator)
            last.append(sampled[:, -1].mean(0))
    predicted, true = torch.stack(last).numpy(), samples.waypoints[:, -1].numpy()
    pairs = {
        "ahead": (predicted[:, 0], true[:, 0]),
        "to the side": (predicted[:, 1], true[:, 1]),
        "distance": (torch.cat(distance).numpy(), samples.distance.numpy()),
    }
    return {name: float(np.corrcoef(*pair)[0, 1]) for name, pair in pairs.items()}


@torch.no_grad()
def place_errors(network: NomadNetwork, data: Sequence[Path], count: int, seed: int) -> dict[str, float]:
    """Return median errors of the predicted places of goals anywhere near."""
    dataset, random = PolicySampleDataset(data, network.sample_form, seed), np.random.default_rng(seed)
    before = network.settings.context * network.settings.spacing
    errors, turned, sure, metres = [], [], [], []
    while len(errors) < count:
        number = int(random.integers(len(dataset.files)))
        frames = len(dataset.files[number])
        present, goal = int(random.integers(before, frames)), int(random.integers(frames))
        sample = dataset.read(SampleFrames(number, present, number, goal, False, 0))
        place, heading = sample.goal_place[:2].tolist(), math.degrees(math.atan2(*sample.goal_place[[3, 2]].tolist()))
        if not 0 < math.hypot(*place) <= FARTHEST:
            continue
        found = network.goal_place(network.condition(sample.seen[None], sample.goal[None], torch.tensor([False]))[0])
        assert found is not None, "a policy that does not predict places"
        errors.append(math.dist((found.ahead, found.left), place))
        turned.append(abs((found.heading - heading + 180) % 360 - 180))
        sure.append(found.certainty >= SURE)
        metres.append(math.hypot(*place))
    of_sure = np.array(errors)[sure]
    return {
        "nothing known, m": float(np.median(metres)), "wrong by, m": float(np.median(errors)),
        "turned by, degrees": float(np.median(turned)), "sure": float(np.mean(sure)),
        "sure, wrong by, m": float(np.median(of_sure)) if len(of_sure) else math.nan,
    }  # fmt: skip


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return the options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", type=Path, help="run or folder of a trained policy; else that of the package")
    parser.add_argument(
        "--data", type=Path, action="append", help="data set of held-out houses, repeat; else the sample"
    )
    parser.add_argument("--moments", type=int, default=200)
    parser.add_argument("--ways", type=int, default=8, help="sampled for each moment")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="folder for policy.json")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    main()
