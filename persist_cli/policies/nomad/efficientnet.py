"""EfficientNet (Tan and Le 2019) with group norms in the place of batch norms, at any size; NoMaD's has those of B0."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

CHANNELS_A_GROUP: Final = 16
SQUEEZE: Final = 4  # the squeezed channels are so many times fewer than those of the block's input

Positive = Annotated[int, Field(ge=1)]
Stage = tuple[Positive, Positive, Positive, Positive, Positive]


@dataclass(frozen=True)
class EncoderSettings:
    """The sizes of an EfficientNet; those of B0 by default.

    Args:
        stem: channels of the first convolution, which halves the image.
        stages: for each stage expansion, channels, blocks, stride of the first block, and size of the kernels.
        head: channels of the last convolution, whose mean over the image is the feature.
    """

    stem: Positive = 32
    stages: tuple[Stage, ...] = (
        (1, 16, 1, 1, 3), (6, 24, 2, 2, 3), (6, 40, 2, 2, 5), (6, 80, 3, 2, 3), (6, 112, 3, 1, 5), (6, 192, 4, 2, 5),
        (6, 320, 1, 1, 3),
    )  # fmt: skip
    head: Positive = 1280


class Convolution(nn.Conv2d):
    """A convolution without bias to ceil(size / stride), padded as TensorFlow does: an odd pixel goes last."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int = 1, groups: int = 1) -> None:
        super().__init__(inputs, outputs, kernel, stride, groups=groups, bias=False)

    def forward(self, image: Tensor) -> Tensor:
        """Return the padded image's convolution."""
        kernel, stride = self.kernel_size[0], self.stride[0]
        pads: list[int] = []
        for size in reversed(image.shape[-2:]):
            total = max((-(-size // stride) - 1) * stride + kernel - size, 0)
            pads += [total // 2, total - total // 2]
        return super().forward(functional.pad(image, pads) if any(pads) else image)


class Block(nn.Module):
    """An inverted residual block: expand, depthwise convolution, squeeze and excitation, project.

    Args:
        inputs: channels.
        stage: expansion, channels, blocks (not read), stride and size of the kernel.
        drop: share of the samples whose block is left out in training, where it is a residual one.
    """

    def __init__(self, inputs: int, stage: Stage, drop: float) -> None:
        super().__init__()
        expansion, outputs, _, stride, kernel = stage
        width, squeezed = inputs * expansion, max(1, inputs // SQUEEZE)
        self.expand = Convolution(inputs, width, 1) if expansion > 1 else None
        self.expand_norm = group_norm(width) if expansion > 1 else None
        self.depthwise = Convolution(width, width, kernel, stride, groups=width)
        self.depthwise_norm = group_norm(width)
        self.squeeze, self.excite = nn.Conv2d(width, squeezed, 1), nn.Conv2d(squeezed, width, 1)
        self.project, self.project_norm = Convolution(width, outputs, 1), group_norm(outputs)
        self.residual, self.drop = stride == 1 and inputs == outputs, drop

    def forward(self, image: Tensor) -> Tensor:
        """Return the block's output."""
        wide = image
        if self.expand is not None and self.expand_norm is not None:
            wide = functional.silu(self.expand_norm(self.expand(image)))
        wide = functional.silu(self.depthwise_norm(self.depthwise(wide)))
        squeezed = functional.silu(self.squeeze(wide.mean((2, 3), keepdim=True)))
        state: Tensor = self.project_norm(self.project(wide * self.excite(squeezed).sigmoid()))
        if not self.residual:
            return state
        if self.training and self.drop:
            kept = torch.rand(len(state), 1, 1, 1, device=state.device) >= self.drop
            state = state * kept / (1 - self.drop)
        return image + state


class EfficientNet(nn.Module):
    """One feature of an image: the mean over the last convolution.

    Args:
        settings: sizes.
        channels: channels of the image: 3, or 6 for two images on top of each other.
        drop: share of the samples for which the last block is left out in training; for earlier ones it is less.
    """

    def __init__(self, settings: EncoderSettings, channels: int, drop: float = 0.2) -> None:
        super().__init__()
        self.stem, self.stem_norm = Convolution(channels, settings.stem, 3, 2), group_norm(settings.stem)
        rows = [(stage, number) for stage in settings.stages for number in range(stage[2])]
        blocks, inputs = [], settings.stem
        for place, (stage, number) in enumerate(rows):
            own = stage if number == 0 else (*stage[:3], 1, stage[4])
            blocks.append(Block(inputs, own, drop * place / len(rows)))
            inputs = stage[1]
        self.blocks = nn.ModuleList(blocks)
        self.head, self.head_norm = Convolution(inputs, settings.head, 1), group_norm(settings.head)
        self.width = settings.head

    def forward(self, image: Float[Tensor, "batch channel height width"]) -> Float[Tensor, "batch head"]:
        """Return the feature of each image."""
        return functional.silu(self.map(image)).mean((2, 3))

    def map(self, image: Float[Tensor, "batch channel height width"]) -> Float[Tensor, "batch head row column"]:
        """Return what the last convolution makes of each place of the image, normalised."""
        image = image.contiguous(memory_format=torch.channels_last)  # faster on a CPU
        state = functional.silu(self.stem_norm(self.stem(image)))
        for block in self.blocks:
            state = block(state)
        places: Tensor = self.head_norm(self.head(state))
        return places


def group_norm(channels: int) -> nn.GroupNorm:
    """A group norm with 16 channels a group, or one group for fewer."""
    return nn.GroupNorm(max(1, channels // CHANNELS_A_GROUP), channels)
