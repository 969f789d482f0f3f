"""A policy by its plugin's name, or by the folder of a trained one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from persist_cli.api.policy import Policy
from persist_cli.errors import PersistError, PluginError, hint
from persist_cli.plugins import list_plugins, make_policy
from persist_cli.policies.trained import TrainedPolicy, find_policy


def open_policy(text: str, settings: Mapping[str, Any] | None = None) -> Policy:
    """Return the policy that ``random``, ``nomad`` or ``runs/policy`` means.

    A name comes before a folder of the same name, which ``./NAME`` means.

    Args:
        text: the name of a policy plugin, or the run or folder of a trained policy.
        settings: plain settings of the plugin.

    Raises:
        PersistError: when there is no such policy, or it cannot be used with these settings.
    """
    settings = dict(settings or {})
    if any(plugin.name == text for plugin in list_plugins("policy")):
        return make_policy(text, settings)
    if Path(text).exists() or len(Path(text).parts) > 1:
        if "checkpoint" in settings:
            raise PersistError(f"{text}: a trained policy; leave out policy.checkpoint, or name its plugin instead")
        return open_trained(find_policy(Path(text)), settings)
    names = sorted({plugin.name for plugin in list_plugins("policy")})
    raise PluginError(f"unknown policy {text!r}; {hint(text, names, 'installed')} (or the folder of a trained one)")


def open_trained(trained: TrainedPolicy, settings: Mapping[str, Any] | None = None) -> Policy:
    """Return a trained policy, wherever it lies, with these plain settings of its plugin."""
    return make_policy(trained.plugin, {**(settings or {}), "checkpoint": str(trained.folder)})


def acting_settings(settings: Any) -> dict[str, Any]:
    """Return what of a policy's settings says how it acts; where its weights lie does not."""
    return {name: value for name, value in asdict(settings).items() if name != "checkpoint"}
