"""Decoration: paint and pictures for rooms and doors, drawn from the house's seed.

Every wall, floor and ceiling has its own texture and colour, so that a place out of view cannot be guessed.
"""

from __future__ import annotations

import colorsys

import numpy as np

from persist_cli.simulators.houses import NORTH, SOUTH, Colour, Door, Paint, Picture, Rectangle, door_span

PICTURES = (1, 5)  # tries a wall, the last not included
PORTRAITS = 82  # in MiniWorld's folder of them
BESIDE = 0.15  # metres between a picture and the next, or a doorway
WALL_TEXTURES = (
    "brick_wall_1", "cinder_blocks_1", "concrete_1", "concrete_3", "concrete_tiles_1", "drywall_1", "stucco_1",
    "marble_1", "marble_2", "wood_1", "wood_2", "wood_planks_1", "rock_1", "cardboard_2", "metal_grill_1", "white_1",
    "door_doom_2", "floor_tiles_white",
)  # fmt: skip
FLOOR_TEXTURES = (
    "floor_tiles_bw_1", "floor_tiles_white", "wood_1", "wood_2", "wood_planks_1", "marble_1", "marble_2",
    "concrete_tiles_1", "asphalt_1", "cardboard_3", "cardboard_4", "rock_1", "brick_wall_1", "grass_1",
)  # fmt: skip
CEILING_TEXTURES = ("ceiling_tiles_1", "ceiling_tile_noborder_1", "drywall_1", "stucco_1", "wood_2", "concrete_3")
POSTERS = (
    "lava_1", "lava_2", "slime_1", "water_1", "water_3", "logo_mila_1", "floor_tiles_bw_1", "marble_1", "grass_2",
)  # fmt: skip
CLOSED_DOORS = ("door_steel_brown", "door_steel_grey", "door_steel_red", "door_doom_1", "door_garage_white")


def decorate(ground: Rectangle, doors: tuple[Door, ...], random: np.random.Generator) -> tuple[Picture, ...]:
    """Pictures for all walls of a room, which overlap neither each other nor a doorway."""
    return tuple(picture for wall in range(4) for picture in _pictures(ground, wall, doors, random))


def paint_walls(random: np.random.Generator) -> tuple[Paint, ...]:
    """A paint for each of four walls."""
    return tuple(paint(WALL_TEXTURES, random) for _ in range(4))


def paint_floor(random: np.random.Generator) -> Paint:
    """A paint for a floor."""
    return paint(FLOOR_TEXTURES, random)


def paint_ceiling(random: np.random.Generator) -> Paint:
    """A paint for a ceiling, paler than the others."""
    return Paint(pick(CEILING_TEXTURES, random), tint(random, 0.25), 1.5)


def paint(textures: tuple[str, ...], random: np.random.Generator) -> Paint:
    """One of the textures in a random colour, its tiles one to two and a half metres wide."""
    return Paint(pick(textures, random), tint(random, 0.6), float(random.uniform(1.0, 2.5)))


def tint(random: np.random.Generator, saturation: float) -> Colour:
    """A random bright colour of at most this saturation, 0 to 1."""
    hue, value = float(random.random()), float(random.uniform(0.8, 1.0))
    return colorsys.hsv_to_rgb(hue, float(random.uniform(0.0, saturation)), value)


def pick(names: tuple[str, ...], random: np.random.Generator) -> str:
    """One of the names, drawn at random."""
    return names[int(random.integers(len(names)))]


def _pictures(ground: Rectangle, wall: int, doors: tuple[Door, ...], random: np.random.Generator) -> list[Picture]:
    """Pictures that overlap neither each other nor a doorway."""
    length = ground.width if wall in (NORTH, SOUTH) else ground.depth
    spans = [door_span(ground, wall, door.passage) for door in doors]
    taken = [(span[0] - BESIDE, span[1] + BESIDE) for span in spans if span is not None]
    pictures = []
    for _ in range(int(random.integers(*PICTURES))):
        picture = _picture(wall, length, random)
        low, high = picture.along - picture.width / 2 - BESIDE, picture.along + picture.width / 2 + BESIDE
        if low > 0 and high < length and all(high < start or low > end for start, end in taken):
            pictures.append(picture)
            taken.append((low, high))
    return pictures


def _picture(wall: int, length: float, random: np.random.Generator) -> Picture:
    kind = random.choice(["portrait", "poster", "closed door", "vent"], p=[0.5, 0.27, 0.15, 0.08])
    along, frame = float(random.uniform(0.0, length)), tint(random, 0.9)
    if kind == "closed door":
        paint = Paint(pick(CLOSED_DOORS, random), tint(random, 0.4))
        return Picture(wall, along, 0.0, float(random.uniform(0.9, 1.2)), 2.05, paint, frame)
    if kind == "vent":
        return Picture(wall, along, float(random.choice([0.15, 2.0])), 0.6, 0.5, Paint("airduct_grate_1"), frame)
    width = float(random.uniform(0.5, 1.2))
    bottom = float(random.uniform(0.9, 1.15))
    if kind == "poster":
        return Picture(wall, along, bottom, width, width * 0.8, Paint(pick(POSTERS, random), tint(random, 0.5)), frame)
    portrait = Paint(f"portraits/{int(random.integers(PORTRAITS))}")
    return Picture(wall, along, bottom, width, width * 1.25, portrait, frame)
