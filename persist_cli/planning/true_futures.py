"""The house that a data set was collected in, opened again, to see what is really there."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.api.simulator import Simulator
from persist_cli.errors import PersistError
from persist_cli.planning.futures import SimulatorFutures
from persist_cli.plugins import load_plugin
from persist_cli.simulators.checked import checked_simulator

ALIKE = 8.0  # levels of 255 by which the start frame may differ on average when it is rendered again


def true_futures(now: Observations, info: TrajectoryInfo) -> tuple[SimulatorFutures | None, str]:
    """Return the true scene with the agent at a frame, or ``None`` and the reason why it is not known.

    The frame is rendered again and compared, so that another version of the simulator is not taken for the truth.

    Args:
        now: the frame.
        info: of its trajectory.
    """
    try:
        simulator = open_again(info)
        return (None, "the data is no simulator's") if simulator is None else placed(simulator, now)
    except PersistError as error:
        return None, str(error)


def open_again(info: TrajectoryInfo) -> Simulator | None:
    """Return the simulator of a trajectory with its scene open, ``None`` where the data is no simulator's.

    Raises:
        PersistError: when that simulator is not here, or does not know the settings.
    """
    name, scene = info.source.get("simulator"), info.source.get("house")
    if not isinstance(name, str) or not isinstance(scene, int):
        return None
    simulator = checked_simulator(name, simulator_settings(name, info))
    simulator.open_scene(scene)
    return simulator


def simulator_settings(name: str, info: TrajectoryInfo) -> dict[str, Any]:
    """Return the settings of the simulator that a trajectory was collected with, as far as it says."""
    actions = {action.name: action for action in info.vocabulary.actions}
    settings: dict[str, Any] = {"height": info.height, "width": info.width}
    if "forward" in actions:
        settings["step"] = actions["forward"].forward
    if "left" in actions:
        settings["turn"] = actions["left"].turn
    known = {field.name for field in dataclasses.fields(load_plugin("simulator", name).settings_type)}
    camera = info.source.get("camera", {})
    return settings | {key: value for key, value in camera.items() if key in known}


def placed(simulator: Simulator, now: Observations) -> tuple[SimulatorFutures | None, str]:
    """Return the futures of a simulator whose agent is put where a frame was seen, unless it sees something else."""
    stance = simulator.stance(now.cameras.world_from_camera[0].numpy())
    if stance is None:
        return None, f"simulator {simulator.name!r} cannot be put at a camera's pose: its stance() is None"
    simulator.place(*stance)
    difference = np.abs(simulator.observe().rgb.astype(float) - now.rgb[0].numpy()).mean()
    if difference > ALIKE:
        return None, f"the simulator shows another start frame (it differs by {difference:.0f} of 255)"
    return SimulatorFutures(simulator), ""
