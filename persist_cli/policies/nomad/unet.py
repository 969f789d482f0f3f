"""The conditional 1-D U-Net of Diffusion Policy (Chi et al. 2023): it predicts the noise in a sequence of motions."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Final

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

NORM_GROUPS: Final = 8
LONGEST_WAVE: Final = 10_000


class ConvolutionBlock(nn.Sequential):
    """Convolution of three, group norm, Mish."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(nn.Conv1d(inputs, outputs, 3, padding=1), nn.GroupNorm(NORM_GROUPS, outputs), nn.Mish())


class ConditionalBlock(nn.Module):
    """Two convolution blocks and a shortcut; what the condition says is added between them.

    Args:
        inputs: channels.
        outputs: channels.
        condition: width of the condition.
    """

    def __init__(self, inputs: int, outputs: int, condition: int) -> None:
        super().__init__()
        self.first, self.second = ConvolutionBlock(inputs, outputs), ConvolutionBlock(outputs, outputs)
        self.condition = nn.Sequential(nn.Mish(), nn.Linear(condition, outputs))
        self.shortcut = nn.Conv1d(inputs, outputs, 1) if inputs != outputs else nn.Identity()

    def forward(self, state: Tensor, condition: Tensor) -> Tensor:
        """Return ``[batch, outputs, place]``."""
        between = self.first(state) + self.condition(condition)[..., None]
        shortcut: Tensor = self.shortcut(state)
        result: Tensor = self.second(between)
        return result + shortcut


class Level(nn.Module):
    """Two conditional blocks; ``resize`` follows them."""

    def __init__(self, inputs: int, outputs: int, condition: int, resize: nn.Module) -> None:
        super().__init__()
        self.first = ConditionalBlock(inputs, outputs, condition)
        self.second = ConditionalBlock(outputs, outputs, condition)
        self.resize = resize

    def forward(self, state: Tensor, condition: Tensor) -> Tensor:
        """Return the state before it is resized."""
        result: Tensor = self.second(self.first(state, condition), condition)
        return result

    def resized(self, state: Tensor) -> Tensor:
        """Return the state at the length of the next level."""
        result: Tensor = self.resize(state)
        return result


class ConditionalUnet(nn.Module):
    """Predicts the noise in sequences of motions, given a condition and the noise level.

    Args:
        channels: channels of each level; each level but the last halves the sequence.
        condition: width of the condition.
        steps: width of the embedding of the noise level.
    """

    def __init__(self, channels: Sequence[int], condition: int, steps: int) -> None:
        super().__init__()
        self.steps = steps
        self.embed_first, self.embed_second = nn.Linear(steps, 4 * steps), nn.Linear(4 * steps, steps)
        width, sizes = condition + steps, [2, *channels]
        pairs = [*itertools.pairwise(sizes)]
        self.down = nn.ModuleList(
            Level(first, second, width, nn.Conv1d(second, second, 3, 2, 1) if number < len(pairs) else nn.Identity())
            for number, (first, second) in enumerate(pairs, start=1)
        )
        self.middle = nn.ModuleList(ConditionalBlock(channels[-1], channels[-1], width) for _ in range(2))
        self.up = nn.ModuleList(
            Level(2 * second, first, width, nn.ConvTranspose1d(first, first, 4, 2, 1))
            for first, second in reversed(pairs[1:])
        )
        self.last, self.out = ConvolutionBlock(channels[0], channels[0]), nn.Conv1d(channels[0], 2, 1)

    @staticmethod
    def levels(modules: nn.ModuleList) -> Iterator[Level]:
        """The levels in a list of modules."""
        yield from (module for module in modules if isinstance(module, Level))

    def forward(
        self,
        motions: Float[Tensor, "batch place 2"],
        step: Int64[Tensor, " batch"],
        condition: Float[Tensor, "batch width"],
    ) -> Float[Tensor, "batch place 2"]:
        """Return the noise in the motions.

        Args:
            motions: normalised motions with noise.
            step: number of the noise level, 0 for the least.
            condition: what was seen, and the goal.
        """
        embedded = nn.functional.mish(self.embed_first(sinusoids(step, self.steps).to(motions.dtype)))
        whole = torch.cat([self.embed_second(embedded), condition], dim=-1)
        state, kept = motions.transpose(1, 2), list[Tensor]()
        for level in self.levels(self.down):
            state = level(state, whole)
            kept.append(state)
            state = level.resized(state)
        for block in self.middle:
            state = block(state, whole)
        for level in self.levels(self.up):
            state = level.resized(level(torch.cat([state, kept.pop()], dim=1), whole))
        noise: Tensor = self.out(self.last(state))
        return noise.transpose(1, 2)


def sinusoids(numbers: Int64[Tensor, " batch"], width: int) -> Float[Tensor, "batch width"]:
    """Sines, then cosines of numbers at ``width / 2`` wavelengths, which rise geometrically."""
    half = width // 2
    exponents = torch.arange(half, device=numbers.device) / (half - 1)
    angles = numbers[:, None] * torch.exp(-math.log(LONGEST_WAVE) * exponents)
    return torch.cat([angles.sin(), angles.cos()], dim=-1)
