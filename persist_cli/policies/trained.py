"""Trained policies on disk: a folder with a card, ``policy.json``, and the weights of the policy's network.

A run's folder stands for its newest checkpoint, and the packaged policy for itself.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from persist_cli.api.checkpoint import POLICY_CARD
from persist_cli.api.network_card import CardKind, NetworkCard, card_folder, find_card, write_card
from persist_cli.api.policy_network import PolicyNetwork
from persist_cli.api.training_scenes import TrainingScenes
from persist_cli.errors import CheckpointError
from persist_cli.io.files import bundled_folder
from persist_cli.io.settings import parse_settings
from persist_cli.io.sha256sums import check_sums, write_sums
from persist_cli.plugins import network_type

PACKAGED: Final = "policy"  # the folder of the policy that comes with the package
TRAIN: Final = "persist finetune houses-64-policy --data DATA --out runs/policy"
POLICY: Final = CardKind(POLICY_CARD, "persist-policy", "policy", "trained policy", TRAIN)


@dataclass(frozen=True)
class TrainedPolicy(NetworkCard):
    """A trained policy on disk; its weights are not loaded yet."""

    def load(self) -> PolicyNetwork:
        """Return the network with its weights, ready to act.

        Raises:
            CheckpointError: when a file is missing or damaged, or does not fit.
        """
        check_sums(self.folder)
        network = make_network(self.plugin, self.settings)
        network.load(self.folder)
        return network.eval()


def make_network(policy: str, settings: dict[str, Any]) -> PolicyNetwork:
    """Make the network of a policy plugin with fresh weights.

    Raises:
        RecipeError: when the policy is none that is trained, or a setting is wrong.
    """
    kind = network_type(policy)
    return kind(parse_settings(kind.settings_type, settings, f"the network of policy {policy!r}"))


def save_policy(network: PolicyNetwork, policy: str, folder: Path, scenes: TrainingScenes | None) -> None:
    """Write a network's weights, a card and ``SHA256SUMS`` into an existing folder, which may hold other files.

    Args:
        network: the network.
        policy: the name of its plugin.
        folder: the folder.
        scenes: the scenes that it was trained on, where they are known.
    """
    network.save(folder)
    write_policy_card(folder, policy, asdict(network.settings), scenes)
    write_sums(folder)


def write_policy_card(folder: Path, policy: str, settings: dict[str, Any], scenes: TrainingScenes | None) -> None:
    """Write the card that makes a folder with a network's weights a trained policy.

    Args:
        folder: the folder.
        policy: the name of the policy's plugin.
        settings: plain settings of its network.
        scenes: the scenes that it was trained on, where they are known.
    """
    write_card(POLICY, folder, policy, settings, scenes)


def find_policy(path: Path) -> TrainedPolicy:
    """Return the trained policy in a folder, or the newest one of a run.

    Raises:
        CheckpointError: when there is none, or its card is damaged.
    """
    return TrainedPolicy(**vars(find_card(POLICY, path)))


def is_policy(path: Path) -> bool:
    """Whether a run or folder is that of a trained policy."""
    return card_folder(POLICY, path) is not None


def packaged_policy() -> TrainedPolicy:
    """Return the trained policy that comes with the package.

    Raises:
        CheckpointError: when this installation has none.
    """
    folder = bundled_folder(PACKAGED)
    if not (folder / POLICY_CARD).is_file():
        raise CheckpointError(f"no trained policy comes with this installation; train one and give its folder: {TRAIN}")
    return find_policy(folder)
