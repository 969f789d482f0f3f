"""Windows of random rooms, which a model of scenes can learn: walls, things, and a view of each."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from persist_cli.api.cells import FREE, OUTSIDE, SOLID
from persist_cli.api.scene_model import Given, SceneForm, SceneSamples

PALETTE = ("free", "solid", "outside", "floor", "ceiling", "wall", "door", "table", "box", "barrel")
FLOOR, CEILING, WALL, TABLE = 3, 4, 5, 7
EYE = 5  # level of the camera


def random_window(shape: tuple[int, int, int], seed: int) -> tuple[Tensor, Tensor]:
    """Classes and colours of two rows of rooms with open doorways and a thing in each."""
    draw = torch.Generator().manual_seed(seed)
    first, second, levels = shape
    classes = torch.full(shape, OUTSIDE, dtype=torch.uint8)
    colors = torch.zeros(*shape, 3, dtype=torch.uint8)

    def number(low: int, high: int) -> int:
        return int(torch.randint(low, max(low + 1, high), (), generator=draw))

    def fill(box: tuple[slice, slice, slice], kind: int, color: Tensor) -> None:
        classes[box], colors[box] = kind, color

    walls = torch.randint(60, 256, (2, 3), generator=draw, dtype=torch.uint8)
    middle, width = number(first // 3, 2 * first // 3), number(second // 4, second // 2)
    for row, (low, high) in enumerate(((1, middle), (middle, first - 2))):
        for left in range(1, second - width - 1, width):
            inside = (slice(low, high + 1), slice(left, left + width + 1))
            fill((*inside, slice(0, levels)), WALL, walls[row])
            room = (slice(low + 1, high), slice(left + 1, left + width))
            fill((*room, slice(1, levels - 1)), FREE, torch.zeros(3))
            fill((*room, slice(0, 1)), FLOOR, torch.tensor([120, 90, 60]))
            fill((*room, slice(levels - 1, levels)), CEILING, torch.tensor([230, 230, 230]))
            things = torch.randint(0, 256, (3,), generator=draw, dtype=torch.uint8)
            x, y = number(low + 1, high - 1), number(left + 1, left + width - 1)
            fill((slice(x, x + 2), slice(y, y + 2), slice(1, 3)), TABLE + number(0, 3), things)
    for left in range(1 + width, second - width - 1, width):
        fill((slice(middle - 3, middle - 1), slice(left, left + 1), slice(1, levels - 1)), FREE, torch.zeros(3))
    return classes, colors


def random_sample(form: SceneForm, seed: int) -> SceneSamples:
    """A window of which one view is known: what its rays pass is free, what they hit is solid."""
    classes, colors = random_window(form.shape, seed)
    draw = torch.Generator().manual_seed(seed + 1)
    pose, lens = random_camera(classes, form, draw)
    given, depth = see(classes, form, pose, lens)
    hit = given == Given.CONTENT
    seen = torch.where(classes == FREE, FREE, SOLID) * hit
    rgb = torch.randint(0, 256, (*form.image, 3), generator=draw, dtype=torch.uint8)
    none = torch.tensor(0)
    return SceneSamples(
        given, seen.to(torch.uint8), colors * hit[..., None], rgb, depth, pose, lens, none, none,
        torch.zeros(3, dtype=torch.uint8), torch.tensor(seed), classes, colors,
    )  # fmt: skip


def random_camera(classes: Tensor, form: SceneForm, draw: torch.Generator) -> tuple[Tensor, Tensor]:
    """Pose and intrinsics of a level camera in a free cell, which looks anywhere around."""
    level = min(EYE, form.shape[2] - 2)
    free = (classes[:, :, level] == FREE).nonzero()
    place = free[int(torch.randint(len(free), (), generator=draw))].tolist()
    angle = float(torch.rand((), generator=draw)) * 2 * math.pi
    ahead, aside = (math.cos(angle), math.sin(angle), 0.0), (math.sin(angle), -math.cos(angle), 0.0)
    pose = torch.eye(4)
    pose[:3, :3] = torch.tensor([aside, (0.0, 0.0, -1.0), ahead]).T
    pose[:3, 3] = torch.tensor([*map(float, place), float(level)]) * form.cells.size
    height, width = form.image
    return pose, torch.tensor([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1.0]])


def see(classes: Tensor, form: SceneForm, pose: Tensor, lens: Tensor) -> tuple[Tensor, Tensor]:
    """Follow the rays of a view in small steps; returns what is given then, and depth."""
    height, width = form.image
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    local = torch.stack([(u - lens[0, 2]) / lens[0, 0], (v - lens[1, 2]) / lens[1, 1], torch.ones_like(u)], -1)
    rays = local @ pose[:3, :3].T
    steps = torch.arange(0.0, max(form.shape), 0.25) * form.cells.size
    points = pose[:3, 3] + rays[..., None, :] * steps[:, None]
    cells = (points / form.cells.size).round().long()
    inside = ((cells >= 0) & (cells < torch.tensor(form.shape))).all(-1)
    cells = cells.where(inside[..., None], 0)
    blocked = ~inside | (classes[tuple(cells.unbind(-1))] != FREE)
    stopped = blocked.long().cumsum(-1)
    given = torch.zeros_like(classes)
    given[tuple(cells[inside & (stopped <= 1) & ((stopped == 0) | blocked)].unbind(-1))] = int(Given.CONTENT)
    first = blocked.long().argmax(-1)
    hit = inside.gather(-1, first[..., None])[..., 0]
    return given, steps[first] * hit
