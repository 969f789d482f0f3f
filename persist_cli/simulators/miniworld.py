"""MiniWorld: generated houses with MiniWorld's textures and meshes, exact poses and metric depth."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from persist_cli.api.actions import ActionVocabulary, walking_actions
from persist_cli.api.cells import CellForm, CellGrid
from persist_cli.api.observations import Frame, TrajectoryInfo
from persist_cli.api.simulator import AgentSettings, Simulator
from persist_cli.errors import DataError
from persist_cli.simulators.building import build_house
from persist_cli.simulators.house_cells import FORM, structure_cells, with_things
from persist_cli.simulators.houses import UP, Ground, House, Rectangle, Thing, is_clear
from persist_cli.simulators.rendering import INSTALL, Renderer, is_installed

GRAIN = 2.0**32  # positions are whole multiples of this part of a metre, so that going back is exact
STRIDE = 0.1  # metres between the places that are checked along a step
REACH = 1.5  # metres to a thing that can be picked up or toggled: nearer ones are below the image
CARRIED_HEIGHT = 0.6  # metres above the floor


@dataclass(frozen=True)
class MiniWorldSettings(AgentSettings):
    """The agent's camera, gait and body.

    Args:
        fov: degrees from the top of the image to its bottom.
        camera_height: metres above the floor.
        pitch: degrees that the camera looks up; negative values look down.
        radius: metres of the agent's body.
    """

    fov: float = 75.0
    camera_height: float = 1.25
    pitch: float = 0.0
    radius: float = 0.2

    def __post_init__(self) -> None:
        if not (self.height > 0 and self.width > 0):
            raise ValueError(f"an image of {self.height}x{self.width} pixels has none")
        if not 10.0 <= self.fov <= 150.0:
            raise ValueError(f"fov {self.fov} is not between 10 and 150 degrees")
        if not 0.1 <= self.radius <= 0.25:
            raise ValueError(f"radius {self.radius} is not between 0.1 and 0.25 m, for which the houses are furnished")
        if not 0.1 <= self.camera_height <= 2.5:
            raise ValueError(f"camera_height {self.camera_height} is not between 0.1 and 2.5 m")
        if not -60.0 <= self.pitch <= 60.0:
            raise ValueError(f"pitch {self.pitch} is not between -60 and 60 degrees")


class MiniWorld(Simulator):
    """An agent in a house of up to six rooms; scene numbers are the houses' seeds.

    Ground positions are (x, z); heading 0 looks along +x, and 90 degrees to the left of that is -z.
    """

    settings_type = MiniWorldSettings

    def __init__(self, settings: MiniWorldSettings) -> None:
        super().__init__(settings)
        self.vocabulary: ActionVocabulary = walking_actions(settings.step, settings.turn)
        self._renderer = Renderer(settings.height, settings.width)
        self._house: House | None = None
        self._walkable: list[Rectangle] = []
        self._things: list[Thing] = []
        self._carried: Thing | None = None
        self._structure: CellGrid | None = None  # cells of the open house without things
        self._cells: tuple[list[Thing], CellGrid] | None = None  # with these things
        self._stale = True  # whether the renderer draws an earlier state of the house
        self._ground: Ground = (0.0, 0.0)
        self._start_heading, self._turned = 0.0, 0.0  # radians and degrees to the left

    def with_settings(self, settings: MiniWorldSettings) -> MiniWorld:
        """A MiniWorld of other settings, which draws with this one's OpenGL where images keep their size."""
        if (settings.height, settings.width) != (self.settings.height, self.settings.width):
            return MiniWorld(settings)
        world = copy.copy(self)
        world.settings, world.vocabulary = settings, walking_actions(settings.step, settings.turn)
        world._house, world._carried, world._structure, world._cells = None, None, None, None
        return world

    @classmethod
    def missing(cls) -> str:
        """Say how MiniWorld's package is installed, where it is missing; OpenGL is not tried."""
        return "" if is_installed() else f"needs {INSTALL}"

    @property
    def house(self) -> House:
        """The open house.

        Raises:
            DataError: before ``open_scene``.
        """
        if self._house is None:
            raise DataError("no scene is open; open_scene comes first")
        return self._house

    def open_scene(self, scene: int) -> None:
        """Build the house of this seed with its things in their places; ``place`` puts the agent into it."""
        if scene < 0:
            raise DataError(f"scene {scene}: seeds of houses are not negative")
        self._house = build_house(scene)
        self._walkable = self.house.walkable(self.settings.radius)
        self._things, self._carried, self._stale = self.house.things, None, True
        self._structure, self._cells = None, None

    def place(self, ground: tuple[float, float], heading: float) -> None:
        """Put the agent at a free ground position with a heading in radians; it drops what it carries.

        Raises:
            DataError: when a wall or a thing is there.
        """
        exact = _exact(ground[0]), _exact(ground[1])
        if self._carried is not None:
            self.act("drop")
        if not self.is_free(exact):
            raise DataError(f"house {self.house.seed}: ({ground[0]:.2f}, {ground[1]:.2f}) is not free")
        self._ground, self._start_heading, self._turned = exact, heading, 0.0

    def observe(self) -> Frame:
        """The image, depth and pose of the agent's camera now."""
        if self._stale:
            self._renderer.load(self.house, self._things_now())
            self._stale = False
        pose = self._world_from_camera()
        rgb, depth = self._renderer.render(pose[:3, 3].tolist(), pose[:3, 2].tolist(), self.settings.fov)
        return Frame(rgb, depth, pose)

    def act(self, action: str) -> bool:
        """Do an action; returns false and changes nothing where something is in the way or out of reach.

        Raises:
            DataError: for an unknown action.
        """
        motion = self.vocabulary[action]
        if motion.interaction:
            return {"pick_up": self._pick_up, "drop": self._drop, "toggle": self._toggle}[action]()
        turned = self._turned + motion.turn
        ahead_x, ahead_z = self.ahead(self._heading)
        ground = (
            self._ground[0] + _exact(motion.forward * ahead_x),
            self._ground[1] + _exact(motion.forward * ahead_z),
        )
        if not self._can_go(ground, turned):
            return False
        self._stale = self._stale or self._carried is not None
        self._ground, self._turned = ground, turned
        return True

    def stance(self, world_from_camera: np.ndarray[Any, Any]) -> tuple[Ground, float]:
        """Ground position and heading of the agent whose camera has a pose."""
        x, _, z = (float(value) for value in world_from_camera[:3, 3])
        return (x, z), math.atan2(-float(world_from_camera[2, 2]), float(world_from_camera[0, 2]))

    @property
    def agent(self) -> tuple[tuple[float, float], float]:
        """Ground position in metres and heading in radians."""
        return self._ground, self._heading

    def is_free(self, ground: tuple[float, float]) -> bool:
        """Whether the agent could stand there."""
        between_walls = any(rectangle.contains(ground) for rectangle in self._walkable)
        return between_walls and is_clear(ground, self.settings.radius, self._things)

    def movable(self) -> list[Ground]:
        """Where things stand that can be picked up."""
        return [thing.ground for thing in self._things if thing.movable]

    def ahead(self, heading: float) -> tuple[float, float]:
        """Unit ground direction of a heading."""
        return math.cos(heading), -math.sin(heading)

    @property
    def bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Lowest and highest ground corner of the house in metres."""
        return self.house.bounds

    @property
    def info(self) -> TrajectoryInfo:
        """Camera, up axis, vocabulary and provenance of the open house."""
        height, width = self.settings.height, self.settings.width
        focal = height / 2 / math.tan(math.radians(self.settings.fov) / 2)
        return TrajectoryInfo(
            scene=f"miniworld/house-{self.house.seed}",
            intrinsics=np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]]),
            height=height,
            width=width,
            world_up=UP,
            vocabulary=self.vocabulary,
            source={"simulator": "miniworld", "house": self.house.seed, "rooms": len(self.house.rooms)},
        )

    @property
    def cell_form(self) -> CellForm:
        """Cells of 0.25 m, with the kinds of walls and things as classes."""
        return FORM

    def cells(self) -> CellGrid:
        """The cells of the open house as it is now; what the agent carries is in none."""
        if self._structure is None:
            self._structure = structure_cells(self.house)
        if self._cells is None or self._cells[0] != self._things:
            self._cells = list(self._things), with_things(self._structure, self._things, self.house.light)
        return self._cells[1]

    @property
    def _heading(self) -> float:
        return self._start_heading + math.radians(self._turned)

    def _world_from_camera(self) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
        """The camera's pose ``[4, 4]`` in OpenCV axes: right, down, forward."""
        (forward_x, forward_z), pose = self.ahead(self._heading), np.eye(4)
        pose[:3, 0] = -forward_z, 0.0, forward_x
        pose[:3, 1] = 0.0, -1.0, 0.0
        pose[:3, 2] = forward_x, 0.0, forward_z
        if self.settings.pitch:
            pose[:3, :3] @= _turned_up(math.radians(self.settings.pitch))
        pose[:3, 3] = self._ground[0], self.settings.camera_height, self._ground[1]
        return pose

    def _can_go(self, ground: Ground, turned: float) -> bool:
        """Whether nothing blocks the agent, with the thing that it carries, on the straight way there."""
        if not all(self.is_free(place) for place in self._way(ground)):
            return False
        if self._carried is None:
            return True
        return self._has_room(self._carried_thing(ground, self._start_heading + math.radians(turned)), self._things)

    def _way(self, ground: Ground) -> list[Ground]:
        """Places along the straight way from the agent, the last one included."""
        strides = max(1, math.ceil(math.dist(self._ground, ground) / STRIDE))
        (x, z), (to_x, to_z) = self._ground, ground
        return [(x + n / strides * (to_x - x), z + n / strides * (to_z - z)) for n in range(1, strides + 1)]

    def _has_room(self, carried: Thing, things: list[Thing]) -> bool:
        """Whether a carried thing touches neither walls nor other things."""
        between_walls = any(area.contains(carried.ground) for area in self.house.walkable(carried.radius))
        return between_walls and is_clear(carried.ground, carried.radius, things)

    def _things_now(self) -> list[Thing]:
        """All things of the house where they are, the carried one too."""
        carried = [self._carried_thing(self._ground, self._heading)] if self._carried is not None else []
        return [*self._things, *carried]

    def _carried_thing(self, ground: Ground, heading: float) -> Thing:
        """The carried thing in front of an agent at this place."""
        if self._carried is None:
            raise DataError("nothing is carried")
        distance = self.settings.radius + self._carried.radius + 0.3
        (x, z) = self.ahead(heading)
        before = ground[0] + distance * x, ground[1] + distance * z
        return replace(self._carried, ground=before, heading=heading, elevation=CARRIED_HEIGHT)

    def _within_reach(self) -> Thing | None:
        """The nearest movable thing ahead; of a pile, which stands in one place, the thing on top."""
        x, z = self.ahead(self._heading)
        near = []
        for thing in self._things:
            offset = thing.ground[0] - self._ground[0], thing.ground[1] - self._ground[1]
            distance, along = math.hypot(*offset), offset[0] * x + offset[1] * z
            if thing.movable and distance < REACH + thing.radius and along > 0.8 * distance:
                near += [(distance, thing)] if self._no_wall_before(thing.ground) else []
        return min(near, key=lambda item: (item[0], -item[1].elevation))[1] if near else None

    def _no_wall_before(self, ground: Ground) -> bool:
        """Whether the straight way from the agent stays within rooms and doorways."""
        areas = self.house.walkable(0.0)
        return all(any(area.contains(place) for area in areas) for place in self._way(ground))

    def _pick_up(self) -> bool:
        thing = self._within_reach()
        if self._carried is not None or thing is None:
            return False
        remaining = [other for other in self._things if other is not thing]
        self._carried = thing
        if not self._has_room(self._carried_thing(self._ground, self._heading), remaining):
            self._carried = None
            return False
        self._things, self._stale = remaining, True
        return True

    def _drop(self) -> bool:
        if self._carried is None:
            return False
        down = replace(self._carried_thing(self._ground, self._heading), elevation=0.0)
        self._things, self._carried, self._stale = [*self._things, down], None, True
        return True

    def _toggle(self) -> bool:
        """Turn the colour of the thing ahead into its complement, and back again."""
        thing = self._within_reach()
        if thing is None or thing.is_mesh:
            return False
        red, green, blue = thing.paint.tint
        toggled = replace(thing, paint=replace(thing.paint, tint=(1 - red, 1 - green, 1 - blue)))
        self._things = [toggled if other is thing else other for other in self._things]
        self._stale = True
        return True


def _turned_up(angle: float) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """The rotation of a camera in OpenCV axes that looks up by an angle in radians."""
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])


def _exact(metres: float) -> float:
    """The nearest multiple of the grain: sums of such numbers are exact."""
    return round(metres * GRAIN) / GRAIN
