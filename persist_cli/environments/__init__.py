"""Houses as Gymnasium environments: imagined by the world model, and true ones of a simulator.

``import persist_cli.environments`` registers ``persist/ImaginedHouse-v0`` and ``persist/SimulatedHouse-v0``. Gymnasium
from 1.0 on finds no environments of installed packages by itself, so this import is needed.

Raises:
    PluginError: when gymnasium is not installed.
"""

from persist_cli.environments.registration import register_envs

register_envs()
