"""What an interaction makes of the cells before the agent: a network of its own, trained on interactions alone.

The transformer generates latents of 4 × 4 columns of cells, in which the one or two cells that an action changes are
lost. This network looks at the cells themselves, and says of each one in reach whether it changes, and into what. Those
aside that lie more than ``BEHIND`` behind the agent it leaves out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int64, Shaped, UInt8
from torch import Tensor, nn

from persist_cli.api.cells import is_solid
from persist_cli.api.reach import CHANGED
from persist_cli.api.scene_model import Given, SceneSamples
from persist_memory.scene_models.codec import COLORS, ResidualBlock
from persist_memory.scene_models.conditions import WAVES, changed_cells, sines, truth
from persist_memory.scene_models.settings import SceneDiffusionSettings

BEHIND = 0.75  # metres along the first axis behind the agent, which looks along it within 45 degrees
RARE = -5.0  # logit of a change, to begin with: hardly a cell changes
# logit from which on a cell changes: 35 %; 15, 25 and 50 % had less IoU of changed cells on validation houses
LIKELY = math.log(0.35 / 0.65)


class Around(NamedTuple):
    """The cells around the agent of each sample.

    Args:
        rows: their numbers along the first axis.
        columns: those along the second axis.
        inside: which of them are in the window; the numbers of others are those of cells at its sides.
        places: metres ahead of the agent, to its left and above its camera.
    """

    rows: Int64[Tensor, "batch row 1"]
    columns: Int64[Tensor, "batch 1 column"]
    inside: Bool[Tensor, "batch row column 1"]
    places: Float[Tensor, "batch row column level 3"]

    def of(self, cells: Shaped[Tensor, "batch first second level *rest"]) -> Tensor:
        """Return the values of the cells, ``[batch, row, column, level, …]``."""
        batch = torch.arange(len(cells), device=cells.device)[:, None, None]
        return cells[batch, self.rows, self.columns]


class Outcome(nn.Module):
    """Says what cells in reach become by an interaction.

    Args:
        settings: windows, palette, actions and sizes.
    """

    def __init__(self, settings: SceneDiffusionSettings) -> None:
        super().__init__()
        self.settings, own, kinds = settings, settings.outcome, len(settings.palette)
        self.contents = nn.Embedding(1 + kinds, own.embedding)  # nothing, and each class
        self.cells = nn.Linear(own.embedding + COLORS + 1 + 3 * 2 * WAVES, own.width)
        self.actions = nn.Embedding(1 + len(settings.actions), own.width)
        self.carried = nn.Embedding(kinds, own.width)
        self.carried_color = nn.Linear(COLORS, own.width)
        self.blocks = nn.ModuleList(ResidualBlock(3, own.width) for _ in range(own.blocks))
        self.told = nn.ModuleList(nn.Linear(own.width, own.width) for _ in range(own.blocks))
        self.last = nn.Linear(2 * own.width, 1 + kinds + COLORS)

    def forward(self, samples: SceneSamples, around: Around) -> tuple[Tensor, Tensor, Tensor]:
        """Return for the cells around the agent the logits of a change and of classes after it, and colours (1 = 255).

        Args:
            samples: what is given, the action, and what is carried; the camera's pose is the agent's.
            around: the cells.
        """
        given, classes, colors = (around.of(part) for part in (samples.given, samples.classes, samples.colors))
        told = (given != Given.NOTHING) & around.inside
        parts = [
            self.contents((1 + classes.int()) * told),
            colors * told[..., None] / 255,
            (given == Given.PAST)[..., None] * 1.0,
            sines(around.places / (2 * CHANGED)),
        ]
        first = self.cells(torch.cat(parts, dim=-1))
        color = self.carried_color(samples.carried_color.float() / 255)
        action = F.silu(self.actions(samples.action) + self.carried(samples.carried) + color)
        values = first.movedim(-1, 1)
        for block, of_action in zip(self.blocks, self.told, strict=True):
            values = block(values + of_action(action)[..., None, None, None])
        said = self.last(F.silu(torch.cat([values.movedim(1, -1), first + action[:, None, None, None]], dim=-1)))
        changes, kinds, painted = said.split([1, len(self.settings.palette), COLORS], dim=-1)
        return changes[..., 0] + RARE, kinds, painted.sigmoid()

    def loss(self, samples: SceneSamples, generators: Sequence[torch.Generator]) -> dict[str, Tensor]:
        """Return the losses of a batch, a mean over samples of sums over cells.

        Args:
            samples: a batch with true classes and colours.
            generators: of each sample, they draw which ones are not told the action.
        """
        drawn = torch.cat([torch.rand(1, generator=generator) for generator in generators])
        dropped = (drawn < self.settings.outcome.drop_action).to(samples.action.device)
        samples = replace(samples, action=samples.action.masked_fill(dropped, 0))
        around = self.around(samples)
        changes, kinds, colors = self(samples, around)
        past = (around.of(samples.given) == Given.PAST) & around.inside
        truly = around.of(changed_cells(samples)) & past
        classes, true_colors = (around.of(part) for part in truth(samples))
        count = len(samples.given)
        change = F.binary_cross_entropy_with_logits(changes[past], truly[past].float(), reduction="sum") / count
        kind = F.cross_entropy(kinds[truly], classes[truly].long(), reduction="sum") / count
        painted = truly & is_solid(classes)
        color = (colors[painted] - true_colors[painted] / 255).abs().sum() / count
        missed = (truly & (changes <= LIKELY)).sum() / truly.sum().clamp_min(1)
        false = (past & ~truly & (changes > LIKELY)).sum() / count
        return {
            "loss": change + kind + color, "change": change, "kind": kind, "color": color, "missed": missed,
            "false": false,
        }  # fmt: skip

    def after(
        self, samples: SceneSamples
    ) -> tuple[UInt8[Tensor, "batch first second level"], UInt8[Tensor, "batch first second level 3"]]:
        """Return classes and colours of the windows afterwards."""
        around = self.around(samples)
        changes, kinds, painted = self(samples, around)
        changed = (changes > LIKELY) & (around.of(samples.given) == Given.PAST) & around.inside
        classes, colors = samples.classes.clone(), samples.colors.clone()
        sample, row, column, level = changed.nonzero().unbind(1)
        places = sample, around.rows[sample, row, 0], around.columns[sample, 0, column], level
        classes[places] = kinds[changed].argmax(-1).to(torch.uint8)
        colors[places] = (painted[changed] * 255).round().to(torch.uint8) * is_solid(classes[places])[:, None]
        return classes, colors

    def around(self, samples: SceneSamples) -> Around:
        """Return the cells around the agents of a batch."""
        size, device = self.settings.cell, samples.given.device
        poses, reach = samples.window_from_camera.float(), math.ceil(CHANGED / size)
        center = (poses[:, :2, 3] / size).round().long()
        rows = center[:, :1, None] + torch.arange(-math.ceil(BEHIND / size), reach + 1, device=device)[:, None]
        columns = center[:, 1:, None] + torch.arange(-reach, reach + 1, device=device)
        first, second, levels = self.settings.shape
        inside = (rows >= 0) & (rows < first) & (columns >= 0) & (columns < second)
        ahead = F.normalize(poses[:, :2, 2], dim=1)[:, :, None, None, None]
        x = (rows * size)[..., None] - poses[:, 0, 3, None, None, None]
        y = (columns * size)[..., None] - poses[:, 1, 3, None, None, None]
        heights = torch.arange(levels, device=device) * size - poses[:, 2, 3, None, None, None]
        forward, aside = x * ahead[:, 0] + y * ahead[:, 1], y * ahead[:, 0] - x * ahead[:, 1]
        places = torch.stack(torch.broadcast_tensors(forward, aside, heights), dim=-1)
        return Around(rows.clamp(0, first - 1), columns.clamp(0, second - 1), inside[..., None], places)
