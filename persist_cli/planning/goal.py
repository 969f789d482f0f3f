"""Goals on the command line: an image file, a frame of a data set, or a place."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from persist_cli.api.ground import GroundMap, ground_axes
from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.api.policy import Goal
from persist_cli.data.images import crop_resize
from persist_cli.data.importers.readers import read_photo
from persist_cli.data.reference import parse_reference
from persist_cli.errors import DataError
from persist_cli.navigation.routes import check_within_reach
from persist_cli.output.console import warn
from persist_cli.rollout.world_model import Agent

NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?"
PLACE = re.compile(rf"^\s*{NUMBER}(?:\s*,\s*{NUMBER}){{1,2}}\s*$", re.IGNORECASE)
FORMS = "an image file, a frame DATA#trajectory:frame, or a place x,y or x,y,z"


def read_goal(text: str, now: Observations, info: TrajectoryInfo) -> Goal:
    """Return the goal that a text names; an image of another size than the start's is cropped, resized, and said so.

    A frame of a data set gives an image and a place. A place of two numbers is on the axes of the maps that are drawn
    (right and up, see ``ground_axes``), at the height of the camera; one of three is in the world.

    Args:
        text: the goal as the user wrote it.
        now: the start frame.
        info: of its trajectory.

    Raises:
        DataError: when it is none of these, cannot be read, or is of another scene.
    """
    if PLACE.match(text):
        return Goal(None, place_of([float(part) for part in text.split(",")], now, info), info.scene)
    if "#" in text and not Path(text).is_file():
        return frame_goal(text, info)
    return Goal(fitted(image_of(text), info, text), None, info.scene)


def check_near(text: str, goal: Goal, agent: Agent, ground: GroundMap) -> None:
    """Raise ``DataError`` when a place is too far from all that an agent knows; see ``check_within_reach``.

    Args:
        text: the goal as the user wrote it.
        goal: any goal; one without a place is never too far.
        agent: knows where it stands and what its memory holds.
        ground: what it knows to be free or occupied.
    """
    if goal.position is not None:
        known = [agent.now.cameras.centers, *([] if agent.memory is None else [agent.memory.points().positions])]
        check_within_reach(f"--goal {text}", goal.position, ground, known)


def place_of(numbers: list[float], now: Observations, info: TrajectoryInfo) -> Float[Tensor, " 3"]:
    """Return the world position, metres, of two numbers on the ground or three in the world."""
    place = torch.tensor(numbers, dtype=torch.float64)
    if len(numbers) == 3:
        return place
    axes = ground_axes(info.world_up)
    height = axes[2] @ now.cameras.centers[-1].double().cpu()
    return torch.cat([place, height[None]]) @ axes


def frame_goal(text: str, info: TrajectoryInfo) -> Goal:
    """Return image and place of a frame of a data set."""
    reference = parse_reference(text)
    frame = reference.single().read([reference.frame])
    if frame.info.scene != info.scene:
        raise DataError(
            f"{text}: is of scene {frame.info.scene!r}, start and memory are of {info.scene!r}; name a goal there"
        )
    rgb = fitted(frame.observations.rgb[0].numpy(), info, text)
    return Goal(rgb, frame.observations.cameras.centers[0].double(), info.scene)


def image_of(text: str) -> np.ndarray:
    """Return the uint8 ``[height, width, 3]`` image of a file."""
    path = Path(text)
    if not path.is_file():
        raise DataError(f"--goal {text}: no such image; give {FORMS}")
    try:
        return read_photo(path)
    except DataError as error:
        raise DataError(f"--goal {error}; give {FORMS}") from error


def fitted(
    image: np.ndarray,
    info: TrajectoryInfo,
    text: str,
) -> UInt8[Tensor, "height width 3"]:
    """Return an image in the size of a trajectory's, its middle if the aspect differs."""
    size = (info.height, info.width)
    if image.shape[:2] != size:
        warn(f"--goal {text}: resized from {image.shape[1]}×{image.shape[0]} to {info.width}×{info.height} pixels")
        image = crop_resize(image.shape[:2], size).rgb(image)
    return torch.from_numpy(np.ascontiguousarray(image))
