"""Inflated 3D Inception (I3D) trained on Kinetics-400, the TF-Hub network of FVD (Carreira & Zisserman 2017).

Tensors are named by their path in the network: ``params.<unit>.Conv_0.weight`` (OIDHW), and for all but the last unit
``params.<unit>.BatchNorm_0.bias`` and ``batch_stats.<unit>.BatchNorm_0.mean`` and ``.var``
(five axes, of which only the last is long).
"""

from __future__ import annotations

import functools
from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

EPSILON = 1e-3  # of the batch normalisation, which has no scale
CLASSES = 400
STEM = {"Conv3d_1a_7x7": (3, 64, 7), "Conv3d_2b_1x1": (64, 64, 1), "Conv3d_2c_3x3": (64, 192, 3)}
LOGITS = "Logits/Conv3d_0c_1x1"
# input channels, then output channels of branch 0, of the two units of branches 1 and 2, and of branch 3
MIXED = {
    "Mixed_3b": (192, 64, 96, 128, 16, 32, 32),
    "Mixed_3c": (256, 128, 128, 192, 32, 96, 64),
    "Mixed_4b": (480, 192, 96, 208, 16, 48, 64),
    "Mixed_4c": (512, 160, 112, 224, 24, 64, 64),
    "Mixed_4d": (512, 128, 128, 256, 24, 64, 64),
    "Mixed_4e": (512, 112, 144, 288, 32, 64, 64),
    "Mixed_4f": (528, 256, 160, 320, 32, 128, 128),
    "Mixed_5b": (832, 256, 160, 320, 32, 128, 128),
    "Mixed_5c": (832, 384, 192, 384, 48, 128, 128),
}
POOLED = {"Mixed_4b": (3, 2), "Mixed_5b": (2, 2)}  # window and stride of the pooling before a block

Weights = Mapping[str, Tensor]


def tensor_shapes() -> dict[str, tuple[int, ...]]:
    """Return the shapes of the tensors of ``model.safetensors`` by name."""
    units = dict(STEM)
    for block, (inputs, zero, one, one_out, two, two_out, three) in MIXED.items():
        units[f"{block}.Branch_0/Conv3d_0a_1x1"] = (inputs, zero, 1)
        units[f"{block}.Branch_1/Conv3d_0a_1x1"] = (inputs, one, 1)
        units[f"{block}.Branch_1/Conv3d_0b_3x3"] = (one, one_out, 3)
        units[f"{block}.Branch_2/Conv3d_0a_1x1"] = (inputs, two, 1)
        units[f"{block}.Branch_2/Conv3d_0b_3x3"] = (two, two_out, 3)
        units[f"{block}.Branch_3/Conv3d_0b_1x1"] = (inputs, three, 1)
    shapes: dict[str, tuple[int, ...]] = {}
    for unit, (inputs, outputs, kernel) in units.items():
        shapes[f"params.{unit}.Conv_0.weight"] = (outputs, inputs, kernel, kernel, kernel)
        shapes[f"params.{unit}.BatchNorm_0.bias"] = (outputs,)
        for name in ("mean", "var"):
            shapes[f"batch_stats.{unit}.BatchNorm_0.{name}"] = (1, 1, 1, 1, outputs)
    return shapes | {f"params.{LOGITS}.Conv_0.weight": (CLASSES, 1024, 1, 1, 1), f"params.{LOGITS}.Conv_0.bias": (400,)}


def logits(weights: Weights, video: Float[Tensor, "video 3 frame 224 224"]) -> Float[Tensor, "video 400"]:
    """Return the logits of the 400 classes, averaged over time.

    Args:
        weights: tensors with the names and shapes of ``tensor_shapes``.
        video: RGB in [-1, 1], at least nine frames.
    """
    state = _unit(weights, "Conv3d_1a_7x7", video, stride=2)
    state = _unit(weights, "Conv3d_2b_1x1", _pool(state, (1, 3, 3), (1, 2, 2)))
    state = _pool(_unit(weights, "Conv3d_2c_3x3", state), (1, 3, 3), (1, 2, 2))
    for block in MIXED:
        if block in POOLED:
            window, stride = POOLED[block]
            state = _pool(state, (window,) * 3, (stride,) * 3)
        state = _mixed(weights, block, state)
    state = functional.avg_pool3d(state, (2, 7, 7), 1)
    weight, bias = weights[f"params.{LOGITS}.Conv_0.weight"], weights[f"params.{LOGITS}.Conv_0.bias"]
    return functional.conv3d(state, weight, bias).mean((2, 3, 4))


def _mixed(weights: Weights, block: str, state: Tensor) -> Tensor:
    """Join the outputs of a block's four branches along the channels."""

    def unit(name: str, inputs: Tensor) -> Tensor:
        return _unit(weights, f"{block}.{name}", inputs)

    return torch.cat(
        [
            unit("Branch_0/Conv3d_0a_1x1", state),
            unit("Branch_1/Conv3d_0b_3x3", unit("Branch_1/Conv3d_0a_1x1", state)),
            unit("Branch_2/Conv3d_0b_3x3", unit("Branch_2/Conv3d_0a_1x1", state)),
            unit("Branch_3/Conv3d_0b_1x1", _pool(state, (3, 3, 3), (1, 1, 1))),
        ],
        dim=1,
    )


def _unit(weights: Weights, unit: str, state: Tensor, stride: int = 1) -> Tensor:
    """Apply a convolution without bias, a batch normalisation without scale, and ReLU."""
    kernel = weights[f"params.{unit}.Conv_0.weight"]
    state = functional.conv3d(_same(state, kernel.shape[2:], (stride,) * 3, 0.0), kernel, stride=stride)
    mean, variance = (weights[f"batch_stats.{unit}.BatchNorm_0.{name}"].flatten() for name in ("mean", "var"))
    bias = weights[f"params.{unit}.BatchNorm_0.bias"]
    return functional.batch_norm(state, mean, variance, torch.ones_like(bias), bias, eps=EPSILON).relu()


def _pool(state: Tensor, window: tuple[int, ...], stride: tuple[int, ...]) -> Tensor:
    return max_pool(_same(state, window, stride, float("-inf")), window, stride)


def max_pool(state: Tensor, window: tuple[int, ...], stride: tuple[int, ...]) -> Tensor:
    """Return what torch's ``max_pool3d`` gives, along one axis after the other: in a seventh of its time on a CPU."""
    for axis, (length, step) in enumerate(zip(window, stride, strict=True), start=2):
        state = functools.reduce(torch.maximum, state.unfold(axis, length, step).unbind(-1))
    return state


def _same(state: Tensor, window: tuple[int, ...] | torch.Size, stride: tuple[int, ...], value: float) -> Tensor:
    """Apply TensorFlow's "same" padding, whose odd pixel comes at the end."""
    padding: list[int] = []
    for size, length, step in zip(state.shape[2:], window, stride, strict=True):
        extra = max((-(-size // step) - 1) * step + length - size, 0)
        padding = [extra // 2, extra - extra // 2, *padding]
    return functional.pad(state, padding, value=value)
