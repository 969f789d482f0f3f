"""The names of the environments in Gymnasium's registry."""

from __future__ import annotations

from typing import Final

from persist_cli.errors import PluginError

MAX_EPISODE_STEPS: Final = 100  # steps of an environment until an episode is truncated, where nobody says another

ENVIRONMENTS: Final = {"persist/ImaginedHouse-v0": "imagined", "persist/SimulatedHouse-v0": "simulated"}


def register_envs() -> None:
    """Register the environments that are not registered yet; their modules are imported when one is made.

    Raises:
        PluginError: when gymnasium is not installed.
    """
    try:
        import gymnasium
    except ImportError as error:
        raise PluginError("the environments need the package gymnasium: pip install 'persist-cli[gym]'") from error
    for name, kind in ENVIRONMENTS.items():
        if name in gymnasium.registry:
            continue
        module, start = f"persist_cli.environments.{kind}", kind.capitalize()
        gymnasium.register(
            name,
            entry_point=f"{module}:{start}House",
            vector_entry_point=f"{module}:{start}HouseVector",
            max_episode_steps=MAX_EPISODE_STEPS,
        )
