"""A micro network of NoMaD's architecture, samples for it, and a run of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch

from persist_cli.api.policy_network import PolicySamples
from persist_cli.io.settings import parse_settings
from persist_cli.policies.nomad.network import NomadNetwork, NomadNetworkSettings

MICRO_POLICY: dict[str, Any] = {
    "height": 32, "width": 32, "context": 1, "waypoints": 4, "spacing": 2, "metres": 0.4, "least": [-1.0, -1.0],
    "most": [1.0, 1.0], "farthest": 8, "nearest": 1, "tokens": 16, "heads": 2, "layers": 1, "channels": [32, 64],
    "encoder": {"stem": 8, "stages": [[1, 8, 1, 2, 3], [2, 16, 1, 2, 3]], "head": 16},
}  # fmt: skip

SHORT_POLICY = ["training.steps=4", "training.batch=2", "training.workers=0", "training.warmup=2"]


def micro_network(**settings: Any) -> NomadNetwork:
    """Make a micro network with weights of seed 0, without anything dropped."""
    torch.manual_seed(0)
    plain = MICRO_POLICY | {"dropout": 0.0, "drop_blocks": 0.0} | settings
    return NomadNetwork(parse_settings(NomadNetworkSettings, plain, "the micro network")).eval()


def random_samples(batch: int = 4, size: int = 32) -> PolicySamples:
    """Make samples of noise, whose waypoints lead straight ahead."""
    draw = torch.Generator().manual_seed(1)
    ahead = torch.arange(1, 5)[:, None] * torch.tensor([0.4, 0.0])
    return PolicySamples(
        seen=torch.randint(0, 256, (batch, 2, size, size, 3), generator=draw, dtype=torch.uint8),
        goal=torch.randint(0, 256, (batch, size, size, 3), generator=draw, dtype=torch.uint8),
        waypoints=ahead.expand(batch, 4, 2).clone(),
        distance=torch.arange(batch).float(),
        goal_place=torch.tensor([1.2, 0.4, 1.0, 0.0]).repeat(batch, 1),
        leads_to_goal=torch.ones(batch, dtype=torch.bool),
        seeds=[*range(batch)],
    )


def policy_stage(data: Path, out: Path, *changes: str) -> list[str]:
    """Arguments of a short finetune run of the micro network."""
    sizes = [f"policy.settings.{name}={json.dumps(value)}" for name, value in MICRO_POLICY.items()]
    return [
        "finetune", "houses-64-policy", "--data", str(data), "--out", str(out), *SHORT_POLICY, *sizes, *changes
    ]  # fmt: skip
