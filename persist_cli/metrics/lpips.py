"""LPIPS v0.1: distance of deep features with weights learnt from human judgements (Zhang et al. 2018)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

from persist_cli.metrics.metric import FrameMetric, Prediction, Setup
from persist_cli.metrics.networks import missing_weights, network_weights, run_network

SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
EPSILON = 1e-10  # of the unit normalisation of channels


@dataclass(frozen=True)
class Convolution:
    """One convolution with its ReLU.

    Args:
        channels: input and output channels.
        kernel: side of the kernel in pixels.
        stride: stride in pixels.
        padding: padding in pixels.
        pool: side of the max pooling of stride 2 before it, 0 for none.
        tap: whether its output is compared.
    """

    channels: tuple[int, int]
    kernel: int = 3
    stride: int = 1
    padding: int = 1
    pool: int = 0
    tap: bool = False


ALEX = (
    Convolution((3, 64), kernel=11, stride=4, padding=2, tap=True),
    Convolution((64, 192), kernel=5, padding=2, pool=3, tap=True),
    Convolution((192, 384), pool=3, tap=True),
    Convolution((384, 256), tap=True),
    Convolution((256, 256), tap=True),
)
VGG = (
    Convolution((3, 64)), Convolution((64, 64), tap=True),
    Convolution((64, 128), pool=2), Convolution((128, 128), tap=True),
    Convolution((128, 256), pool=2), Convolution((256, 256)), Convolution((256, 256), tap=True),
    Convolution((256, 512), pool=2), Convolution((512, 512)), Convolution((512, 512), tap=True),
    Convolution((512, 512), pool=2), Convolution((512, 512)), Convolution((512, 512), tap=True),
)  # fmt: skip


class Lpips(FrameMetric):
    """LPIPS of RGB frames by one of its networks."""

    better = "lower"
    network: ClassVar[tuple[Convolution, ...]]
    layers: ClassVar[str]
    least_size: ClassVar[int]  # pixels; of smaller images a pooling leaves nothing

    @property
    def definition(self) -> str:
        """A sentence with version, network, layers and image size."""
        return (
            f"LPIPS v0.1 ({self.layers}, learnt heads), RGB in [-1, 1], no resize (images of at least "
            f"{self.least_size} px), float32"
        )

    @property
    def weights(self) -> tuple[str, ...]:
        """The one set of weights that holds network and heads."""
        return (self.name,)

    def obstacle(self, setup: Setup) -> str | None:
        """The reason when images are too small for the network's poolings, or weights are missing."""
        if min(setup.height, setup.width) < self.least_size:
            return f"images of {setup.width}×{setup.height} are smaller than the network's least, {self.least_size} px"
        return missing_weights(self.name)

    def measure(self, prediction: Prediction) -> Float[Tensor, " frame"]:
        """The distance of each frame, 0 for an exact copy."""
        weights = network_weights(self.name, tensor_shapes(self.network))
        return run_network(
            lambda rgb, truth: perceptual_distance(weights, self.network, rgb, truth),
            prediction.rgb,
            prediction.truth.rgb,
        )


class LpipsAlex(Lpips):
    """LPIPS by AlexNet, the usual one for comparing methods."""

    name = "lpips-alex"
    title = "LPIPS-Alex"
    network = ALEX
    layers = "AlexNet, relu1 to relu5"
    least_size = 31


class LpipsVgg(Lpips):
    """LPIPS by VGG16."""

    name = "lpips-vgg"
    title = "LPIPS-VGG"
    network = VGG
    layers = "VGG16, relu1_2 2_2 3_3 4_3 5_3"
    least_size = 16


def tensor_shapes(network: tuple[Convolution, ...]) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the tensors of ``model.safetensors`` by name."""
    shapes: dict[str, tuple[int, ...]] = {}
    for number, layer in enumerate(network):
        inputs, outputs = layer.channels
        shapes[f"conv{number}.weight"] = (outputs, inputs, layer.kernel, layer.kernel)
        shapes[f"conv{number}.bias"] = (outputs,)
    taps = [layer for layer in network if layer.tap]
    return shapes | {f"head{number}.weight": (1, layer.channels[1], 1, 1) for number, layer in enumerate(taps)}


def perceptual_distance(
    weights: Mapping[str, Tensor],
    network: tuple[Convolution, ...],
    rgb: UInt8[Tensor, "frame height width 3"],
    truth: UInt8[Tensor, "frame height width 3"],
) -> Float[Tensor, " frame"]:
    """Return the sum over taps of the mean over pixels of head · (difference of unit features)² (Zhang et al., (1))."""
    return feature_distance(weights, features(weights, network, rgb), features(weights, network, truth))


def feature_distance(
    weights: Mapping[str, Tensor],
    taps: Sequence[Float[Tensor, "frame channel rows columns"]],
    true_taps: Sequence[Float[Tensor, "#frame channel rows columns"]],
) -> Float[Tensor, " frame"]:
    """Return the same distance of what ``features`` gave; the truth may be a single frame, with which all compare."""
    distances = [
        functional.conv2d((generated - true).square(), weights[f"head{number}.weight"]).mean((1, 2, 3))
        for number, (generated, true) in enumerate(zip(taps, true_taps, strict=True))
    ]
    return torch.stack(distances).sum(0)


def features(
    weights: Mapping[str, Tensor], network: tuple[Convolution, ...], rgb: UInt8[Tensor, "frame height width 3"]
) -> list[Float[Tensor, "frame channel rows columns"]]:
    """Return the outputs of the taps, with the channels of each pixel normalised to unit length."""
    image = rgb.permute(0, 3, 1, 2).float() / 127.5 - 1
    shift, scale = (image.new_tensor(values)[:, None, None] for values in (SHIFT, SCALE))
    state, taps = (image - shift) / scale, []
    for number, layer in enumerate(network):
        if layer.pool:
            state = functional.max_pool2d(state, layer.pool, 2)
        weight, bias = weights[f"conv{number}.weight"], weights[f"conv{number}.bias"]
        state = functional.conv2d(state, weight, bias, layer.stride, layer.padding).relu()
        if layer.tap:
            taps.append(state / (state.square().sum(1, keepdim=True).sqrt() + EPSILON))
    return taps
