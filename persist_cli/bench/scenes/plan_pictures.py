"""Plans of some measured images: what was known, what each row says, and what is true, seen from above."""

from __future__ import annotations

import colorsys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Bool, UInt8
from torch import Tensor

from persist_cli.api.cells import OUTSIDE, SOLID, is_solid
from persist_cli.bench.scenes.completion_part import kept_samples
from persist_cli.bench.scenes.scene_bench import SceneBench
from persist_cli.bench.scenes.views import View
from persist_cli.output.data_uri import data_uri

MOST_VIEWS: Final = 12

MOST_SEEDS: Final = 3

SCALE: Final = 4  # pixels of a cell

UNKNOWN: Final = (255, 255, 255)

COLORS: Final = {
    "free": (235, 235, 235), "solid": (120, 120, 120), "outside": (205, 214, 226), "floor": (226, 214, 190),
    "ceiling": (226, 214, 190), "wall": (60, 60, 66), "door": (200, 120, 40),
}  # fmt: skip

THING_HUES: Final = (0.17, 1.0)  # yellow to red; a door is orange


@dataclass(frozen=True)
class ViewPictures:
    """The pictures of one image as data URIs.

    Args:
        name: of the image.
        image: what the camera sees.
        plans: by what they show, the camera in the middle looking to the right.
    """

    name: str
    image: str
    plans: Mapping[str, str]


def picture_views(bench: SceneBench) -> list[ViewPictures]:
    """Draw the first images with the plans of all rows."""
    return [picture_view(bench, view) for view in bench.views[:MOST_VIEWS]]


def picture_view(bench: SceneBench, view: View) -> ViewPictures:
    """Draw one image with the plans of all rows."""
    colors = class_colors(bench.palette)
    plans = {"seen": plan(view, view.known.classes, view.known.known, colors)}
    for row in bench.rows:
        samples = kept_samples(bench, row, view)
        for seed in range(min(MOST_SEEDS, len(samples["classes"]))):
            name = f"{row.name}, seed {seed}" if row.random else row.name
            plans[name] = plan(view, samples["classes"][seed], samples["known"][seed], colors)
    return ViewPictures(view.name, data_uri(view.frame.rgb[0], 3), plans)


def class_colors(palette: Sequence[str]) -> UInt8[Tensor, "class 3"]:
    """Return a colour for each class: fixed ones for what a house is made of, hues unlike a door's for all others."""
    others = [name for name in palette if name not in COLORS]
    low, high = THING_HUES
    hues = {
        name: tuple(round(255 * part) for part in colorsys.hsv_to_rgb(hue, 0.75, 0.85))
        for name, hue in zip(others, torch.linspace(low, high, len(others)).tolist(), strict=True)
    }
    return torch.tensor([COLORS.get(name, hues.get(name, (0, 0, 0))) for name in palette], dtype=torch.uint8)


def plan(
    view: View,
    classes: UInt8[Tensor, "first second level"],
    known: Bool[Tensor, "first second level"],
    colors: UInt8[Tensor, "class 3"],
) -> str:
    """Return a plan: for each column the highest thing below the ceiling, else the floor; doors over what is below."""
    palette = view.truth.form.palette
    top = classes.shape[2] - 1
    shown = torch.where(known, classes, SOLID)[..., 0].clone()
    if "floor" in palette:
        shown[shown == SOLID] = palette.index("floor")  # what was seen down there
    seen = known.any(-1)
    for level in range(1, top):
        something = known[..., level] & is_solid(classes[..., level])
        shown = torch.where(something, classes[..., level], shown)
    beyond = (known & (classes == OUTSIDE))[..., :top].any(-1)
    shown = torch.where(beyond, OUTSIDE, shown)
    if "door" in palette:
        shown[(known & (classes == palette.index("door"))).any(-1)] = palette.index("door")
    picture = torch.where(seen[..., None], colors[shown.long()], torch.tensor(UNKNOWN, dtype=torch.uint8))
    return data_uri(view.region.ahead(picture).permute(1, 0, 2).flip(0).contiguous(), SCALE)
