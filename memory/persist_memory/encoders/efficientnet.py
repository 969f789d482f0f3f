"""EfficientNet-Lite0 features (Tan and Le 2019; Lite: no squeeze-and-excitation, ReLU6), small and quick on a CPU."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import torch
from jaxtyping import Float, UInt8
from pydantic import PositiveInt
from torch import Tensor
from torch.nn import functional

from persist_cli.api.encoder import Encoder
from persist_cli.errors import CheckpointError, RecipeError
from persist_cli.io.files import read_tensors
from persist_cli.io.hub import cached_weight

WEIGHTS: Final = "efficientnet-lite0"
BATCH_NORM_EPSILON: Final = 1e-3
# Those of the original's preprocessing. The PyTorch port that released the weights uses ImageNet's mean and deviation
# in its example. With those the stem's outputs on real indoor frames have 3.5 times the variance that its batch norm
# was trained on, with these 0.7 times.
MEAN, DEVIATION = 127.0, 128.0


@dataclass(frozen=True)
class Block:
    """An inverted residual block: its stride and its output channels; the size of its kernel is that of its weights."""

    stride: int
    channels: int


STAGES: Final = (  # number of blocks, stride of the first one, channels
    (1, 1, 16), (2, 2, 24), (2, 2, 40), (3, 2, 80), (3, 1, 112), (4, 2, 192), (1, 1, 320),
)  # fmt: skip
BLOCKS: Final = tuple(
    Block(stride if number == 0 else 1, channels) for count, stride, channels in STAGES for number in range(count)
)


@dataclass(frozen=True)
class EfficientNetLite0Settings:
    """The block of the network that gives the features.

    Args:
        block: the block whose output is taken, counted from 0 as in the released weights. Block 10 is the last one at
            a sixteenth of the image's size, with 112 channels.
        size: pixels of the image's longer side when it is encoded; ``None`` keeps the size of the image.
    """

    block: int = 10
    size: PositiveInt | None = None


class EfficientNetLite0(Encoder):
    """Features of a frozen EfficientNet-Lite0; its fetched weights are opened when first needed."""

    settings_type = EfficientNetLite0Settings
    costly = True
    settings: EfficientNetLite0Settings

    def __init__(self, settings: EfficientNetLite0Settings) -> None:
        super().__init__(settings)
        if not 0 <= settings.block < len(BLOCKS):
            raise RecipeError(f"encoder {self.name!r}: block {settings.block} is not one of 0 to {len(BLOCKS) - 1}")
        self._device = torch.device("cpu")

    @property
    def channels(self) -> int:
        """Width of the block."""
        return BLOCKS[self.settings.block].channels

    def to(self, device: torch.device | str) -> EfficientNetLite0:
        """Encode on ``device`` from now on."""
        self._device = torch.device(device)
        return self

    @torch.no_grad()
    def encode(self, rgb: UInt8[Tensor, "frame height width 3"]) -> Float[Tensor, "frame rows columns channel"]:
        """Return the block's output, computed frame by frame so that no frame depends on its neighbours."""
        weights = {name: tensor.to(self._device) for name, tensor in self._tensors.items()}
        parts = [features(weights, self._pixels(frame.to(self._device)), self.settings.block) for frame in rgb.split(1)]
        return torch.cat(parts).permute(0, 2, 3, 1)

    @cached_property
    def _tensors(self) -> dict[str, Tensor]:
        folder = cached_weight(WEIGHTS)
        if folder is None:
            raise CheckpointError(f"weights {WEIGHTS} are not here: persist weights fetch {WEIGHTS}")
        tensors, _ = read_tensors(folder / "model.safetensors")
        missing = sorted(set(tensor_names(self.settings.block)) - set(tensors))
        if missing:
            raise CheckpointError(f"{folder}/model.safetensors: no EfficientNet-Lite0, it lacks {missing[0]}")
        return tensors

    def _pixels(self, rgb: UInt8[Tensor, "frame height width 3"]) -> Float[Tensor, "frame 3 height width"]:
        image = rgb.permute(0, 3, 1, 2).float()
        scale = (self.settings.size or max(image.shape[-2:])) / max(image.shape[-2:])
        if scale != 1:
            size = [max(1, round(side * scale)) for side in image.shape[-2:]]
            image = functional.interpolate(image, size=size, mode="bicubic", antialias=True, align_corners=False)
        return (image.clamp(0, 255) - MEAN) / DEVIATION


def features(
    weights: dict[str, Tensor], image: Float[Tensor, "frame 3 height width"], last: int
) -> Float[Tensor, "frame channel rows columns"]:
    """Output of block ``last`` for normalised images."""
    state = functional.relu6(_batch_norm(weights, "_bn0", _convolve(image, weights["_conv_stem.weight"], 2)))
    for number, block in enumerate(BLOCKS[: last + 1]):
        state = _block(weights, f"_blocks.{number}", state, block.stride)
    return state


def tensor_names(last: int) -> Iterator[str]:
    """Names of the weights that ``features`` needs for the blocks up to ``last``."""
    norm_tensors = ("weight", "bias", "running_mean", "running_var")
    yield from ("_conv_stem.weight", *(f"_bn0.{tensor}" for tensor in norm_tensors))
    for number in range(last + 1):
        expand = (("_expand_conv", "_bn0"),) if number else ()
        for convolution, norm in (*expand, ("_depthwise_conv", "_bn1"), ("_project_conv", "_bn2")):
            yield f"_blocks.{number}.{convolution}.weight"
            yield from (f"_blocks.{number}.{norm}.{tensor}" for tensor in norm_tensors)


def _block(weights: dict[str, Tensor], name: str, state: Tensor, stride: int) -> Tensor:
    """Expand, depthwise convolution, project; and add the input when the shape is still that of the input."""
    residual = state
    if f"{name}._expand_conv.weight" in weights:
        state = functional.conv2d(state, weights[f"{name}._expand_conv.weight"])
        state = functional.relu6(_batch_norm(weights, f"{name}._bn0", state))
    kernel = weights[f"{name}._depthwise_conv.weight"]
    state = functional.relu6(_batch_norm(weights, f"{name}._bn1", _convolve(state, kernel, stride, len(kernel))))
    state = _batch_norm(weights, f"{name}._bn2", functional.conv2d(state, weights[f"{name}._project_conv.weight"]))
    return state + residual if state.shape == residual.shape else state


def _convolve(state: Tensor, kernel: Tensor, stride: int, groups: int = 1) -> Tensor:
    """A convolution to ceil(size / stride), padded as TensorFlow does: an odd pixel goes to the right and bottom."""
    pads: list[int] = []
    for size, side in zip(reversed(state.shape[-2:]), reversed(kernel.shape[-2:]), strict=True):
        total = max((math.ceil(size / stride) - 1) * stride + side - size, 0)
        pads += [total // 2, total - total // 2]
    return functional.conv2d(functional.pad(state, pads), kernel, stride=stride, groups=groups)


def _batch_norm(weights: dict[str, Tensor], name: str, state: Tensor) -> Tensor:
    mean, variance = weights[f"{name}.running_mean"], weights[f"{name}.running_var"]
    return functional.batch_norm(
        state, mean, variance, weights[f"{name}.weight"], weights[f"{name}.bias"], eps=BATCH_NORM_EPSILON
    )
